"""What the students of the benchmark of structural shifts return before any learning.

``python -m docs.shifts.play runs/shifts`` plays episodes with the policy that each finished run began with, made anew
from its settings and its teacher, and adds their mean return to ``results/shifts/zero_shot.csv``.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from acmr.settings.compose import as_override, compose_config, parse
from acmr.settings.run_spec import specify
from docs.shifts.runs import PUBLISHED, ZERO_SHOT, read

COLUMNS = ["pair", "method", "seed", "episodes", "mean_return"]
#: Episodes with sampled actions, as in training, and the environment's seed of the first.
EPISODES, FIRST_SEED = 10, 1000


def zero_shot(pair: str, method: str, seed: int, runs: Path, chosen: str | None) -> float:
    """Mean return of the policy that a run began with.

    Args:
        pair: Its environment.
        method: Its cell.
        seed: Its seed.
        runs: The folder of the profile's runs, among them its teacher's.
        chosen: What its trials chose what is gone to count as; None: there were none.
    """
    from acmr.evaluation.rollout import play
    from acmr.run.preparation import prepare

    words = ["profile=shifts", f"env={pair}", f"experiment={method}", f"seed={seed}", "tracking=off"]
    config = parse(compose_config([*words, f"output_dir={as_override(str(runs.parent))}"]))
    if chosen is not None:
        config = replace(config, transfer=replace(config.transfer, impute=chosen))
    prepared = prepare(specify(config))
    actor = prepared.networks.actor.eval()
    told = play(actor, config.env, prepared.wrapper_states, episodes=EPISODES, seed=FIRST_SEED, stochastic=True)
    return fmean(episode.episodic_return for episode in told)


def main() -> None:
    """Plays for all finished runs below a folder that are not in the table yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the runs, as runs/shifts, with those of the teachers")
    parser.add_argument("out", type=Path, nargs="?", default=PUBLISHED, help="where the table lies")
    given = parser.parse_args()
    found, made = read(given.runs), dict[tuple[str, str, int], list[str]]()
    told = given.out / ZERO_SHOT
    if told.is_file():
        with told.open(encoding="utf-8") as file:
            made = {(row[0], row[1], int(row[2])): row for row in list(csv.reader(file))[1:]}
    for run in found.runs.to_dict("records"):
        key = (run["pair"], run["method"], run["seed"])
        if key not in made:
            chosen = (found.data.summaries[run["run"]].get("audition") or {}).get("chosen")
            made[key] = [*map(str, key), str(EPISODES), f"{zero_shot(*key, given.runs, chosen):.2f}"]
    told.parent.mkdir(parents=True, exist_ok=True)
    with told.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *(made[key] for key in sorted(made))])


if __name__ == "__main__":
    main()

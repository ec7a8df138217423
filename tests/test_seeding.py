"""``seeding``: runs of one seed share its random numbers, or each draws from numbers of its own."""

from __future__ import annotations

import csv
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from analysis_runs import rows_reaching, write_cut, write_run
from hypothesis import given
from hypothesis import strategies as st
from test_sweeps_stop import plan
from torture import ANT, Run

from acmr.cells import CELLS, draws_apart, plain_name
from acmr.records import MOST_SEED
from acmr.run.random_streams import RandomStreams, random_streams
from acmr.settings.compose import compose_config, parse
from acmr.settings.run_spec import RunSpec, specify, teacher_spec
from acmr.tracking.wandb_tracker import labels, short_name
from analysis.analyze import analyze
from analysis.loading.load import load
from analysis.loading.missing import missing_runs
from analysis.statistics.study.equivalence import equivalence
from analysis.statistics.study.pairs import blocked, paired_comparisons

INDEPENDENT = "seeding=independent"
TOTAL = 20_000


def spec(*overrides: str) -> RunSpec:
    return specify(parse(compose_config(list(overrides))))


def drawn(streams: RandomStreams) -> list[float]:
    """A first number of every stream."""
    torch_streams = (streams.networks, streams.acting, streams.learning)
    numbers = [float(torch.rand(1, generator=generator, dtype=torch.float64)) for generator in torch_streams]
    return [*numbers, float(streams.replay.random()), float(streams.exploration.random()), streams.environment]


@given(st.integers(0, MOST_SEED), st.integers(0, MOST_SEED), st.text(min_size=1), st.text(min_size=1))
def test_no_stream_is_shared_unless_seed_and_name_are(seed, other, name, another):
    kinds = dict.fromkeys([(seed, None), (seed, name), (seed, another), (other, None), (other, name)])
    first = {kind: drawn(random_streams(kind[0], apart=kind[1])) for kind in kinds}
    assert first[seed, name] == drawn(random_streams(seed, apart=name))
    # The seed of an environment has 32 bits, too few to be sure of.
    for one, two in combinations(first.values(), 2):
        assert not set(one[:-1]) & set(two[:-1])


def test_a_paired_run_draws_what_the_seed_alone_gives():
    children = np.random.SeedSequence(7).spawn(6)
    assert random_streams(7).environment == int(children[5].generate_state(1)[0])
    assert random_streams(7).exploration.random() == np.random.default_rng(children[4]).random()


@pytest.mark.parametrize("cell", CELLS)
def test_it_is_the_same_cell_in_a_directory_of_its_own(cell):
    usual, own = spec(f"experiment={cell}"), spec(f"experiment={cell}", INDEPENDENT)
    stopped = spec(f"experiment={cell}", INDEPENDENT, "stop=threshold", "stop_after=9")
    assert [usual.cell, own.cell, stopped.cell] == [cell] * 3
    assert len({usual.name, own.name, stopped.name}) == 3
    # What the streams are derived from: where it stops does not matter.
    assert usual.kin == own.kin == stopped.kin == usual.name == plain_name(own.name) == plain_name(stopped.name)
    assert [draws_apart(made.name) for made in (usual, own, stopped)] == [False, True, True]
    assert f" {INDEPENDENT} " in f"{own.command} "
    assert "seeding" not in usual.command


def test_names_too_long_to_be_read_have_kin_too():
    long = [f"agent.options.{letter * 30}=1" for letter in "abcde"]
    made = [spec("env=armless_humanoid", *(f"+{word}" for word in long), *more) for more in ([], [INDEPENDENT])]
    assert made[0].name != made[1].name
    assert made[0].kin == made[1].kin == made[0].name


def test_teachers_stay_what_they_are():
    student = spec("experiment=A2", INDEPENDENT, "seed=3")
    assert teacher_spec(student.config).directory == teacher_spec(spec("experiment=A2", "seed=3").config).directory
    assert teacher_spec(student.config).config.seeding == "paired"


def test_a_mirror_keeps_them_apart():
    made = [spec("experiment=A2", *more) for more in ([], [INDEPENDENT], [INDEPENDENT, "stop=threshold"])]
    assert [short_name(one) for one in made] == [
        "A2-s1-paper", "A2-s1-paper-independent", "A2-s1-paper-stopped-independent"
    ]  # fmt: skip
    assert len({labels(one)["group"] for one in made}) == 3


def test_the_run_that_teaches_stands_for_the_sweeps_own(tmp_path):
    made = plan(tmp_path, ("H0", "H1", "A0", "A2"), INDEPENDENT, "stop=threshold", seeds=(1, 2))
    names = {run.spec.cell: run.spec.name for run in made.runs}
    assert len(made.runs) == 8
    assert names["H0"] == "humanoid-none"
    assert all(draws_apart(names[cell]) for cell in ("H1", "A0", "A2"))
    stands_for = {run.stands_for for run in made.runs if run.spec.cell == "H0"}
    assert stands_for == {(f"humanoid-none-{INDEPENDENT}-stop=threshold",)}
    # Alone it teaches nobody, and is what was asked for.
    alone = plan(tmp_path, ("H0", "A0"), INDEPENDENT)
    assert {run.spec.name for run in alone.runs} == {
        f"{env}-none-{INDEPENDENT}" for env in ("humanoid", "armless_humanoid")
    }


def first_episodes(run: Run) -> list[tuple[str, str]]:
    rows = csv.DictReader(run.finish()["episodes.csv"].decode().splitlines())
    return [(row["global_step"], row["episodic_return"]) for row in rows]


@pytest.mark.parametrize("seeding", ["paired", "independent"])
def test_runs_of_one_seed_share_their_first_episodes_or_none(seeding, tmp_path):
    # Two rates make two kinds of runs, which act alike until learning begins: at random.
    common = (*ANT, "agent.learning_starts=200", f"seeding={seeding}")
    one, two = (first_episodes(Run(tmp_path / rate, (*common, f"agent.q_lr={rate}"))) for rate in ("0.01", "0.02"))
    shared = [ours == theirs for ours, theirs in zip(one, two, strict=False) if int(ours[0]) <= 200]
    assert len(shared) > 1
    assert all(shared) if seeding == "paired" else not any(shared)


@pytest.mark.slow
def test_one_that_stops_is_still_the_beginning_of_the_full_one(tmp_path):
    common = (*ANT, INDEPENDENT, "threshold=1e9")
    full, left = (
        Run(tmp_path / name, (*common, *more)).finish()["episodes.csv"]
        for name, more in {"full": (), "left": ("stop=threshold", "stop_after=200")}.items()
    )
    assert full.startswith(left)
    assert full.count(b"\n") > left.count(b"\n") > 2


def matrix_of(root: Path, apart: dict[str, bool], seeds: int = 3) -> None:
    for place, (cell, own) in enumerate(apart.items()):
        for seed in range(1, seeds + 1):
            rows = rows_reaching(6000 + 700 * seed * (place + 1), TOTAL)
            write_run(root, cell, seed, rows, total=TOTAL, **({"seeding": "independent"} if own else {}))


@pytest.mark.parametrize(
    "apart",
    [
        {"A0": True, "A1": True, "A2": True},
        {"A0": False, "A1": True, "A2": True},
        {"A0": True, "A1": False, "A2": False},
    ],
)
def test_independent_runs_are_in_no_pair(tmp_path, apart):
    matrix_of(tmp_path, apart)
    analysis = analyze(load(tmp_path))
    runs, pairs = analysis.measured, list(combinations(apart, 2))
    table = paired_comparisons(runs, analysis.data.episodes, pairs).set_index(["reference", "index"])
    margins = equivalence(runs, pairs, 500).set_index(["reference", "index"])
    for one, two in pairs:
        expected = 0 if apart[one] or apart[two] else 3
        assert table.loc[(one, two), "pairs"] == margins.loc[(one, two), "pairs"] == expected
        if not expected:
            assert table.loc[(one, two), "note"] == "runs of one seed are independent"
            assert np.isnan(table.loc[(one, two), "p_paired"])
            assert np.isnan(margins.loc[(one, two), "p_tost_paired"])
    assert blocked(runs)["note"].tolist() == ["fewer than two seeds pair all cells"]
    # The tests of independent samples have all of them.
    comparisons = analysis.comparisons.set_index(["reference", "index"])
    assert comparisons.loc[("A0", "A2"), "p_value"] >= 0


def test_it_is_known_by_its_summary_its_settings_or_its_name(tmp_path):
    rows = rows_reaching(8000, TOTAL)
    said = write_run(tmp_path / "a", "A0", 1, rows, total=TOTAL, summary={"seeding": "independent"})
    (said / "config.yaml").unlink()
    write_run(tmp_path / "b", "A0", 1, rows, total=TOTAL, seeding="independent")
    named = write_run(tmp_path / "c", "A0", 1, rows, total=TOTAL)
    for name in ("config.yaml", "summary.json"):
        (named / name).unlink()
    named.parent.rename(named.parent.with_name(f"{named.parent.name}-{INDEPENDENT}"))
    write_run(tmp_path / "d", "A0", 1, rows, total=TOTAL)
    found = {folder: load(tmp_path / folder).runs for folder in "abcd"}
    assert {folder: runs["apart"].tolist() for folder, runs in found.items()} == {
        "a": [True], "b": [True], "c": [True], "d": [False]
    }  # fmt: skip
    assert [runs["cell"].tolist() for runs in found.values()] == [["A0"]] * 4


def test_of_two_of_one_cell_and_seed_the_paired_one_counts(tmp_path):
    rows = rows_reaching(8000, TOTAL)
    write_cut(tmp_path, "A0", 1, rows, TOTAL)
    other = write_run(tmp_path, "A0", 1, rows_reaching(9000, TOTAL), total=TOTAL, seeding="independent")
    moved = other.parent.with_name(f"{other.parent.name}-{INDEPENDENT}")
    other.parent.rename(moved)
    runs = load(tmp_path).runs.set_index("apart")
    assert runs["counted"].to_dict() == {False: True, True: False}
    assert runs.loc[True, "state"] == "duplicate"
    assert runs.loc[True, "reason"].endswith("needs seeds, or an output_dir, of its own")


def test_what_is_missing_is_asked_for_in_the_same_way(tmp_path):
    matrix_of(tmp_path, {"A0": True, "A2": True}, seeds=2)
    lacking = [run.command for run in missing_runs(load(tmp_path)) if (run.cell, run.seed) == ("A0", 3)]
    assert lacking
    assert all(f" {INDEPENDENT}" in line for line in lacking)

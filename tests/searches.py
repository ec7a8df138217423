"""What the tests of searches share: tiny settings, a formula in the place of trainings, real searches as processes."""

import json
import math
import os
import subprocess
import sys
from types import SimpleNamespace

from guides import ROOT

TINY = [
    "env=gym", "env.id=Pendulum-v1", "env.max_episode_steps=50", "profile=quick", "total_timesteps=300",
    "agent.learning_starts=100", "agent.hidden_sizes=[8]", "tracking=off",
]  # fmt: skip
RATE, LENGTH = "agent.q_lr=interval(1e-4,1e-1)", "env.max_episode_steps"


def parsed(*words: str):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return OverridesParser.create().parse_overrides(list(words))


def spaced(*words: str):
    from acmr.app.tune.space import make_space

    return make_space(parsed(*words))


def searched(folder, space, trials: int, prune: bool = True, workers: int = 2, train=None):
    """A search whose runs are worth what a formula says."""
    from acmr.app.tune.search import Search, Wanted
    from sweeps.sweeper import Settings

    folder.mkdir(exist_ok=True)
    search = Search(folder, space, "steps_to_threshold", Wanted(trials, None, prune, Settings(False, 0, 1, 1)), workers)
    search.trainings = train or Formula()
    return search


class Formula:
    """Stands in for trainings: least at q_lr = 1e-2, and worth as much more as the seed is greater.

    Each look finds each run a tenth further; at half of its length it is worth one and a half of what it is at its end.
    """

    def __init__(self):
        self.jobs, self.cuts, self.at = [], [], {}

    def run(self, look):
        while look():
            self.at = {job: tenth + 1 for job, tenth in self.at.items()}
        return 0

    def begin(self, job):
        self.jobs.append(tuple(job))
        self.at[tuple(job)] = 0
        config = SimpleNamespace(most_steps=1000, agent=SimpleNamespace(learning_starts=100))
        return SimpleNamespace(job=tuple(job), config=config, made=SimpleNamespace(directory=tuple(job)))

    def cut(self, training):
        self.cuts.append(training.job)

    def is_over(self, training):
        return self.at[training.job] >= 10

    def heights(self, training):
        return {
            tenth: self.worth(training) * (2 - tenth / 10) for tenth in range(1, min(10, self.at[training.job]) + 1)
        }

    def worth(self, training):
        return self.value(training.job)

    @staticmethod
    def value(job):
        said = dict(word.split("=") for word in job)
        return 1000 * (math.log10(float(said["agent.q_lr"])) + 2) ** 2 + 10 * int(said["seed"])


def reports(folder) -> list[tuple[int, int]]:
    """Each trial and step for which a value was written into Optuna's journal."""
    lines = [json.loads(line) for line in (folder / "study.log").read_text().splitlines()]
    return [(line["trial_id"], line["step"]) for line in lines if "intermediate_value" in line]


def start(folder, *words: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "acmr.app.tune", *words]
    return subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def prepared(folder, metric: str, height: float, *queue: dict[str, object]) -> None:
    """A study with five trials that were worth as much all the time, and some that are to be asked for first."""
    import optuna

    from acmr.app.tune.study import open_study

    folder.mkdir(parents=True)
    study = open_study(folder, "minimize" if metric == "steps_to_threshold" else "maximize")
    for _ in range(5):
        study.add_trial(
            optuna.create_trial(
                value=height,
                params={LENGTH: 50},
                distributions={LENGTH: optuna.distributions.CategoricalDistribution((50, 150))},
                user_attrs={"values": {"1": height}},
                intermediate_values=dict.fromkeys(range(1, 11), height),
            )
        )
    for params in queue:
        study.enqueue_trial(params)

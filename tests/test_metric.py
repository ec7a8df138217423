"""What a run is worth to a search: against the run's own files, and told to a sweeper of Hydra's that is not ours."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pandas as pd
import pytest
import yaml
from guides import ROOT

from acmr.app.metric import metric_line, metric_of
from acmr.config import METRICS, NONE, ConfigError
from acmr.evaluation.cli import main as evaluate
from acmr.run.experiment import run_experiment
from acmr.settings.compose import compose_config, parse
from acmr.settings.run_spec import specify

TINY = [
    "env=gym", "env.id=Pendulum-v1", "profile=quick", "total_timesteps=1000", "agent.learning_starts=900",
    "agent.hidden_sizes=[8]", "tracking=off", "progress=off", "threshold=-3000", "consecutive=5",
    "env.max_episode_steps=200",
]  # fmt: skip
#: A sweeper of somebody's own: tries all combinations, and writes down what it is told.
RECORDER = """
import json
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

class Recorder(BasicSweeper):
    def sweep(self, arguments):
        found = super().sweep(arguments)
        with open("told.json", "w") as file:
            json.dump([job.return_value for batch in found for job in batch], file)
        return found
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("metric"))
        spec = specify(parse(compose_config(TINY)))
        return spec, run_experiment(spec, lambda line: None), spec.directory.absolute()


def test_each_is_what_the_runs_files_say(run, monkeypatch, capsys):
    spec, summary, directory = run
    monkeypatch.chdir(directory.parents[3])
    episodes = pd.read_csv(directory / "episodes.csv")
    assert len(episodes) == 5
    assert (episodes["episodic_return"] > -3000).all()
    assert metric_of(spec, summary, "steps_to_threshold") == summary["steps_to_threshold"] == 1000
    assert metric_of(spec, summary, "final_return") == pytest.approx(episodes["episodic_return"].mean())
    # All episodes have 200 steps, so that the mean height of the curve is the mean.
    assert metric_of(spec, summary, "area") == pytest.approx(episodes["episodic_return"].mean())
    assert evaluate([str(directory)]) == 0
    wanted = json.loads((directory / "evaluation.json").read_text())["mean_return"]
    assert metric_of(spec, summary, "evaluation") == pytest.approx(wanted)
    capsys.readouterr()


def test_what_never_reached_counts_as_all_its_steps(run):
    spec, summary, _ = run
    censored = summary | {"steps_to_threshold": None}
    assert metric_of(spec, censored, "steps_to_threshold") == 1000
    config = parse(compose_config([*TINY, "metric=steps_to_threshold"]))
    assert "not reached" in metric_line(config, censored, 1000)
    assert "not reached" not in metric_line(config, summary, 1000)
    stopping = specify(parse(compose_config([*TINY, "stop=threshold", "stop_after=600"])))
    assert metric_of(stopping, censored, "steps_to_threshold") == 600


def test_what_there_is_nothing_to_tell_from(run):
    spec, summary, _ = run
    assert np.isnan(metric_of(spec, summary | {"final_return": None}, "final_return"))
    assert np.isnan(metric_of(spec, summary | {"status": "diverged"}, "evaluation"))


def test_it_is_no_part_of_a_run():
    plain = specify(parse(compose_config(TINY)))
    assert plain.config.metric == NONE
    for metric in METRICS[1:]:
        asked = specify(parse(compose_config([*TINY, f"metric={metric}"])))
        assert (asked.name, asked.changes, asked.cell, asked.command) == (
            plain.name, plain.changes, plain.cell, plain.command,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["metric=reward"], "metric=reward: must be one of none, steps_to_threshold, final_return, area, evaluation"),
        (["metric=area", "stop=threshold"], "make all their steps; type stop=horizon, or metric=steps_to_threshold"),
    ],
)
def test_what_is_no_metric(words, says):
    with pytest.raises(ConfigError) as caught:
        parse(compose_config([*TINY, *words]))
    assert says in str(caught.value)


def start(folder, *words: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)])}
    command = [sys.executable, str(ROOT / "run.py"), *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_a_sweeper_that_is_not_ours_is_told_and_goes_on_after_a_run_that_diverges(tmp_path):
    (tmp_path / "hydra_plugins").mkdir()
    (tmp_path / "hydra_plugins" / "recorder.py").write_text(RECORDER)
    file = tmp_path / "conf" / "hydra" / "sweeper" / "recorder.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("_target_: hydra_plugins.recorder.Recorder\nmax_batch_size: null\nparams: null\n")
    done = start(
        tmp_path, "-m", "--config-dir", "conf", "hydra/sweeper=recorder", *TINY, "metric=final_return",
        "agent.q_lr=1e-3,1e30,2e-3",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads((tmp_path / "told.json").read_text())
    assert done.stdout.count("\nfinal_return: ") == len(told) == 3
    places = sorted((tmp_path / "runs").glob("*/*/seed_1/summary.json"))
    returns = {json.loads(place.read_text())["final_return"] for place in places}
    assert set(told) == returns


@pytest.mark.slow
def test_hydras_basic_sweeper_leaves_nothing_but_runs(tmp_path):
    done = start(tmp_path, "-m", "hydra/sweeper=basic", *TINY, "agent.q_lr=1e-3,2e-3")
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert len(list((tmp_path / "runs").glob("*/*/seed_1/summary.json"))) == 2
    assert "final_return" not in done.stdout
    done = start(tmp_path, "-m", "hydra/sweeper=basic", "hydra/launcher=local", *TINY)
    assert done.returncode == 2
    assert done.stderr == (
        "error: hydra/launcher=local: trains for the sweeper of this program only; with hydra/sweeper=basic type "
        "hydra/launcher=basic, or leave it out\n"
    )


def test_a_plugin_that_cannot_be_loaded_or_makes_no_sweeper_of_its_settings_is_one_line(tmp_path):
    plugins = tmp_path / "hydra_plugins" / "hydra_picky_sweeper"
    plugins.mkdir(parents=True)
    # As nevergrad's and Ax's of 2021 do with Python 3.11.
    (plugins / "__init__.py").touch()
    (plugins / "broken.py").write_text("raise ValueError('mutable default')\n")
    done = start(tmp_path, *TINY)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "error: Hydra's plugin hydra_picky_sweeper cannot be loaded (ValueError: mutable default); install another "
        "version of it, or type pip uninstall hydra-picky-sweeper\n"
    )
    (plugins / "broken.py").unlink()
    (tmp_path / "hydra_plugins" / "recorder.py").write_text(
        "from hydra._internal.core_plugins.basic_sweeper import BasicSweeper\n\nclass Picky(BasicSweeper):\n"
        "    def __init__(self, budget):\n        self.budget = int(budget)\n\n"
        "    def sweep(self, arguments):\n        raise KeyError(f'no such value: {arguments[-1]}')\n"
    )
    file = tmp_path / "conf" / "hydra" / "sweeper" / "picky.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("_target_: hydra_plugins.recorder.Picky\nbudget: many\n")
    words = ("-m", "--config-dir", "conf", "hydra/sweeper=picky", *TINY)
    done = start(tmp_path, *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: hydra.sweeper: ")
    assert "invalid literal for int() with base 10: 'many'" in done.stderr
    assert done.stderr.count("\n") == 1
    done = start(tmp_path, *words, "hydra.sweeper.budget=3", "seed=7")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: hydra/sweeper=picky: KeyError: 'no such value: seed=7'\n"


@pytest.mark.slow
def test_nevergrad_is_told_what_runs_are_worth(tmp_path):
    if find_spec("nevergrad") is None:
        pytest.skip("nevergrad not installed; type pip install -c constraints.txt hydra-nevergrad-sweeper==1.4.0.dev10")
    done = start(
        tmp_path, "-m", "hydra/sweeper=nevergrad", "hydra.sweeper.optim.budget=3", "hydra.sweeper.optim.maximize=true",
        *TINY, "metric=final_return", "agent.q_lr=interval(1e-4,1e-2)",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = yaml.safe_load((tmp_path / "optimization_results.yaml").read_text())
    summaries = [json.loads(path.read_text()) for path in (tmp_path / "runs").glob("*/*/seed_1/summary.json")]
    assert len(summaries) == 3
    assert found["best_evaluated_result"] == pytest.approx(max(each["final_return"] for each in summaries))

"""Searches with the real Optuna: against a formula whose least value is known, and as users start them."""

import math
import os
import re
import signal
import subprocess
import sys
import time

import pytest
from guides import ROOT
from test_export import needs

from acmr.config import ConfigError

TINY = [
    "env=gym", "env.id=Pendulum-v1", "env.max_episode_steps=50", "profile=quick", "total_timesteps=300",
    "agent.learning_starts=100", "agent.hidden_sizes=[8]", "tracking=off",
]  # fmt: skip
#: Optuna is an extra, which is there where the slow tests run.
pytestmark = pytest.mark.slow
RATE = "agent.q_lr=interval(1e-4,1e-1)"


@pytest.fixture(autouse=True)
def _optuna():
    needs("optuna")


def parsed(*words: str):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return OverridesParser.create().parse_overrides(list(words))


def spaced(*words: str):
    from acmr.app.tune.space import make_space

    return make_space(parsed(*words))


def searched(folder, space, trials: int, prune: bool = True, workers: int = 2, train=None):
    """A search whose runs are worth what a formula says, or a function of the jobs."""
    from acmr.app.tune.search import Search, Wanted
    from sweeps.sweeper import Settings

    folder.mkdir(exist_ok=True)
    search = Search(folder, space, "steps_to_threshold", Wanted(trials, None, prune, Settings(False, 0, 1, 1)), workers)
    search.trainings = train or Formula()
    return search


class Formula:
    """Stands in for trainings: least at q_lr = 1e-2, and worth as much more as the seed is greater."""

    def __init__(self):
        self.jobs = []

    def train(self, jobs):
        self.jobs += jobs
        return [self.value(job) for job in jobs], 0

    @staticmethod
    def value(job):
        said = dict(word.split("=") for word in job)
        return 1000 * (math.log10(float(said["agent.q_lr"])) + 2) ** 2 + 10 * int(said["seed"])


def test_a_choice_that_hydra_takes_quoted_only_is_one_of_its_names():
    space = spaced("transfer=hidden", "freeze='true','false',gradual")
    assert space.choices["freeze"].choices == ("true", "false", "gradual")
    assert space.job({"freeze": "true"}, 1) == ["transfer=hidden", "freeze=true", "seed=1"]


def test_words_become_what_optuna_chooses_from():
    space = spaced(
        RATE, "agent.tau=interval(0.1,0.5)", "agent.gamma=tag(log,interval(0.9,0.99))",
        "agent.batch_size=interval(64,512)",
        "agent.policy_frequency=range(1,5)", "transfer=hidden,named", "agent.hidden_sizes=[8]", "seed=3,1",
        "metric=area",
    )  # fmt: skip
    assert space.fixed == ("agent.hidden_sizes=[8]",)
    assert space.seeds == (3, 1)
    assert space.lines() == [
        "agent.q_lr: 0.0001 to 0.1, by its logarithm", "agent.tau: 0.1 to 0.5",
        "agent.gamma: 0.9 to 0.99, by its logarithm",
        "agent.batch_size: 64 to 512", "agent.policy_frequency: 1 to 4", "transfer: one of hidden, named",
    ]  # fmt: skip
    params = {"agent.q_lr": 0.00012345678, "agent.tau": 0.5, "agent.batch_size": 65, "transfer": "named"}
    assert space.job(params, 3) == [
        "agent.hidden_sizes=[8]", "agent.q_lr=0.0001235", "agent.tau=0.5", "agent.batch_size=65", "transfer=named",
        "seed=3",
    ]  # fmt: skip
    assert space.command(params).endswith("-m 'agent.hidden_sizes=[8]' agent.q_lr=0.0001235 agent.tau=0.5 "
                                          "agent.batch_size=65 transfer=named seed=3,1")  # fmt: skip


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["seed=1,2"], "nothing to search: say from what to choose, as in "),
        (["agent.q_lr=interval(1e-3,1e-4)"], "the first number has to be the smaller one"),
        (["agent.q_lr=tag(log,interval(-1,1))"], "a logarithm needs numbers above zero"),
        (["agent.q_lr=tag(sqrt,interval(1,2))"], "tag(sqrt, ...): must be log or linear"),
        (["agent.batch_size=interval(1.5,4)"], "the setting is a whole number"),
        ([RATE, "seed=interval(1,3)"], "seed=interval(1,3): has no end; sweep a list"),
        ([RATE, "seed=1,1"], "different whole numbers are needed"),
        ([RATE, "seed=a"], "different whole numbers are needed"),
        (["agent.tau=range(1,4,0)"], "type a step other than 0"),
        (["agent.hidden_sizes=[8],[9]"], "values to choose from are numbers and words, not [8]"),
    ],
)
def test_what_cannot_be_searched(words, says):
    with pytest.raises(ConfigError) as caught:
        spaced(*words)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["agent.q_lr=interval(0,1)"], "agent.q_lr=0.0: a number in"),
        (["agent.q_learning=1e-3,1e-2"], "agent.q_learning"),
        (["threads=1,2"], "threads: changes no result; give it one value"),
        ([RATE, "metric=none"], "a search is after something"),
        ([RATE, "metric=area", "stop=threshold"], "type stop=horizon, or metric=steps_to_threshold"),
        (["transfer=none,hiden"], "hiden"),
    ],
)
def test_what_no_trial_could_run_is_refused_before_the_first(words, says):
    from acmr.app.tune.search import _try_out
    from acmr.settings.errors import USER_ERRORS, explain

    with pytest.raises(USER_ERRORS) as caught:
        _try_out(spaced(*TINY, *words), parsed(*TINY, *words))
    assert says in explain(caught.value)


def test_it_finds_what_is_best_and_cuts_short_what_is_not(tmp_path, capsys):
    space = spaced(RATE, "seed=1,2,3")
    search = searched(tmp_path / "it", space, trials=40, workers=3)
    assert search.run() == 0
    study, jobs = search._study, search.trainings.jobs
    assert study.best_params["agent.q_lr"] == pytest.approx(1e-2, rel=0.3)
    assert study.best_value == pytest.approx(Formula.value(space.job(study.best_params, 2)))
    states = [trial.state.name for trial in study.trials]
    assert (len(states), states.count("FAIL")) == (40, 0)
    assert states.count("PRUNED") > 3
    # No run twice, and as many as trials had seeds.
    assert len(set(map(tuple, jobs))) == len(jobs) == sum(len(t.user_attrs["values"]) for t in study.trials)
    said = capsys.readouterr().out
    assert said.count("no more seeds") == states.count("PRUNED")
    page = (tmp_path / "it" / "search.md").read_text()
    assert f"{states.count('COMPLETE')} trials are complete, {states.count('PRUNED')} were cut short" in page
    assert space.command(study.best_params) in page
    assert page.index(f"| {study.best_trial.number} |") == page.index("| ", page.index("|---|"))
    assert "PED-ANOVA): agent.q_lr 100%" in page
    assert " seed=4,5,6\n" in page
    for name in re.findall(r"\]\((\w+\.png)\)", page):
        assert (tmp_path / "it" / name).read_bytes().startswith(b"\x89PNG")
    assert len(list((tmp_path / "it").glob("*.png"))) == 3


def test_the_command_that_goes_on_is_the_one_that_was_typed(monkeypatch):
    from sweeps.screen.display import command_line

    monkeypatch.setattr(sys, "argv", ["/somewhere/acmr/app/tune/__main__.py", "-m", "hydra/sweeper=tune", RATE])
    monkeypatch.setattr(sys, "orig_argv", ["python3", "/venv/bin/acmr", "tune", RATE])
    assert command_line() == f"acmr tune '{RATE}'"
    monkeypatch.setattr(sys, "orig_argv", ["python3", "-m", "acmr.app.tune", RATE])
    assert command_line() == f"python -m acmr.app.tune '{RATE}'"


def test_all_seeds_at_once_where_nothing_is_cut_short(tmp_path):
    search = searched(tmp_path / "it", spaced(RATE, "seed=1,2,3"), trials=4, prune=False, workers=6)
    assert search.run() == 0
    assert len(search.trainings.jobs) == 12
    assert search._abreast == 2


def test_it_goes_on_where_it_was_and_further(tmp_path, capsys):
    class Ends(Formula):
        def train(self, jobs):
            if len(self.jobs) >= 5:
                return [None] * len(jobs), 128 + signal.SIGINT
            return super().train(jobs)

    space = spaced(RATE, "seed=1,2")
    first = searched(tmp_path / "it", space, 6, train=Ends())
    assert first.run() == 130
    assert "stopped by SIGINT; to go on: " in capsys.readouterr().out
    second = searched(tmp_path / "it", space, 6)
    assert second.run() == 0
    assert "2 were under way" in capsys.readouterr().out
    jobs = [tuple(job) for each in (first, second) for job in each.trainings.jobs]
    assert len(set(jobs)) == len(jobs) <= 12
    third = searched(tmp_path / "it", space, 6)
    assert (third.run(), third.trainings.jobs) == (0, [])
    assert searched(tmp_path / "it", space, 8).run() == 0
    params = [trial.params["agent.q_lr"] for trial in third._study.trials]
    assert len(set(params)) == len(params) == 8
    with pytest.raises(ConfigError, match="is of another search"):
        searched(tmp_path / "it", spaced("agent.q_lr=interval(1e-3,1e-1)"), 8)


def test_it_ends_where_all_trials_fail(tmp_path, capsys):
    class Fails(Formula):
        def train(self, jobs):
            return [None for _ in jobs], 1

    search = searched(tmp_path / "it", spaced(RATE), 40, train=Fails())
    assert search.run() == 1
    assert 5 <= len(search._study.trials) <= 6
    assert re.search(r"error: the last \d trials failed; why: ", capsys.readouterr().out)


def start(folder, *words: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "acmr.app.tune", *words]
    return subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def test_a_search_that_is_killed_goes_on_with_what_is_there(tmp_path):
    words = (*TINY, RATE, "agent.tau=0.005,0.05", "seed=1,2", "trials=3", "metric=final_return", "workers=2")
    search = start(tmp_path, *words)
    while not list(tmp_path.glob("runs/quick/*/*/summary.json")):
        assert search.poll() is None, search.communicate()
        time.sleep(0.1)
    search.send_signal(signal.SIGKILL)
    search.communicate()
    written = {path: path.read_bytes() for path in tmp_path.glob("runs/quick/*/*/summary.json")}
    said, errors = start(tmp_path, *words).communicate(timeout=500)
    assert errors == ""
    assert "going on: " in said
    (page,) = tmp_path.glob("runs/tune/*/search.md")
    for path, before in written.items():
        assert path.read_bytes() == before
    summaries = list(tmp_path.glob("runs/quick/*/*/summary.json"))
    assert len(summaries) == 6
    (best,) = re.findall(r"^best: (.+)$", said, re.M)
    assert best in page.read_text()
    done = subprocess.run(
        [sys.executable, str(ROOT / "run.py"), *best.split(" ", 2)[2].replace("'", "").split(), "plan=true"],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "2 runs: 2 done, 0 missing" in done.stdout


def test_students_are_searched_after_their_teachers(tmp_path):
    words = (
        "transfer=hidden,expand", "seed=1", "trials=2", "metric=area", "workers=2", "profile=quick",
        "total_timesteps=300", "agent.hidden_sizes=[8,8]", "tracking=off",
    )  # fmt: skip
    search = start(tmp_path, *words)
    said, errors = search.communicate(timeout=500)
    assert (search.returncode, errors) == (0, ""), said
    teachers = [path for path in tmp_path.glob("runs/quick/*/seed_1/summary.json") if "-none" in str(path)]
    assert len(teachers) == 1
    assert len(list(tmp_path.glob("runs/quick/*/seed_1/summary.json"))) in (2, 3)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["seed=1,2"], "error: nothing to search: say from what to choose, as in python -m acmr.app.tune"),
        ([RATE, "trials=none"], "error: trials=none: an integer of at least 1 is needed"),
        ([RATE, "study=../mine"], "error: study=../mine: the name of a folder is needed"),
        ([RATE, "agent.q_lrr=1"], "error: agent.q_lrr: no such setting"),
    ],
)
def test_bad_input_is_one_line(words, says, tmp_path):
    search = start(tmp_path, *TINY, *words)
    said, errors = search.communicate(timeout=200)
    assert (search.returncode, said) == (2, "")
    assert errors.startswith(says)
    assert errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == []

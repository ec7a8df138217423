"""Searches with the real Optuna: against a formula whose least value is known, and as users start them."""

import re
import signal
import sys
import warnings

import pytest
from searches import RATE, TINY, Formula, parsed, reports, searched, spaced
from test_export import needs

from acmr.config import ConfigError

#: Optuna is an extra, which is there where the slow tests run.
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _optuna():
    needs("optuna")


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
    from acmr.app.tune.study import try_out
    from acmr.settings.errors import USER_ERRORS, explain

    with pytest.raises(USER_ERRORS) as caught:
        try_out(spaced(*TINY, *words), parsed(*TINY, *words))
    assert says in explain(caught.value)


def test_it_finds_what_is_best_and_cuts_short_what_is_not(tmp_path, capsys):
    space = spaced(RATE, "seed=1,2,3")
    search = searched(tmp_path / "it", space, trials=24, workers=3)
    with warnings.catch_warnings():
        # Optuna warns of a value for a step that has one.
        warnings.simplefilter("error")
        assert search.run() == 0
    study, jobs = search._study, search.trainings.jobs
    assert study.best_params["agent.q_lr"] == pytest.approx(1e-2, rel=0.3)
    assert study.best_value == pytest.approx(Formula.value(space.job(study.best_params, 2)))
    states = [trial.state.name for trial in study.trials]
    assert (len(states), states.count("FAIL")) == (24, 0)
    cut = [trial for trial in study.trials if trial.state.name == "PRUNED"]
    # No run twice; those that were cut short were stopped, and only those.
    assert len(set(jobs)) == len(jobs)
    steps = [trial.user_attrs["cut"]["step"] for trial in cut]
    assert min(steps) == 300
    assert len(steps) > 5
    # The tenth is no border of a seed: all were stopped on the way but those that ended right there.
    assert len(search.trainings.cuts) == sum(step < 1000 for step in steps) > 5
    for trial in cut:
        where = trial.user_attrs["cut"]
        assert max(trial.intermediate_values) == 10 * (where["seed"] - 1) + where["step"] // 100
    assert not [
        trial for trial in study.trials if trial.state.name == "COMPLETE" and len(trial.intermediate_values) != 30
    ]
    said = capsys.readouterr().out
    assert said.count("cut short: worse than the median at seed ") == len(cut)
    page = (tmp_path / "it" / "search.md").read_text()
    assert f"{states.count('COMPLETE')} trials are complete, {len(cut)} were cut short" in page
    rows = page.split("## Cut short\n")[1].split("\n## ")[0]
    for where in (trial.user_attrs["cut"] for trial in cut):
        assert f"| {where['seed']} | {where['step']:,} | 1,000 | {where['worth']:,.6g} |" in rows
    assert rows.count("\n| ") == len(cut) + 1
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
    assert reports(tmp_path / "it") == []
    assert search.trainings.cuts == []


def test_it_goes_on_where_it_was_and_further(tmp_path, capsys):
    class Ends(Formula):
        def run(self, look):
            while look() and len(self.jobs) < 7:
                self.at = {job: tenth + 1 for job, tenth in self.at.items()}
            return 128 + signal.SIGINT

    space = spaced(RATE, "seed=1,2")
    first = searched(tmp_path / "it", space, 6, train=Ends())
    assert first.run() == 130
    assert "stopped by SIGINT; to go on: " in capsys.readouterr().out
    # As a kill in the middle of writing leaves it.
    journal = tmp_path / "it" / "study.log"
    (tmp_path / "it" / "study.log.lock").symlink_to("it/study.log")
    journal.write_bytes(journal.read_bytes() + b'{"op_code":8,"worker')
    second = searched(tmp_path / "it", space, 6)
    assert second.run() == 0
    assert "2 were under way" in capsys.readouterr().out
    # What was under way is asked for again, and nothing else; and no step is told twice.
    jobs = [job for each in (first, second) for job in each.trainings.jobs]
    assert len(jobs) - len(set(jobs)) == 2
    told = reports(tmp_path / "it")
    assert len(set(told)) == len(told) > 60
    third = searched(tmp_path / "it", space, 6)
    assert (third.run(), third.trainings.jobs) == (0, [])
    assert searched(tmp_path / "it", space, 8).run() == 0
    params = [trial.params["agent.q_lr"] for trial in third._study.trials]
    assert len(set(params)) == len(params) == 8
    with pytest.raises(ConfigError, match="is of another search"):
        searched(tmp_path / "it", spaced("agent.q_lr=interval(1e-3,1e-1)"), 8)


def test_it_ends_where_all_trials_fail(tmp_path, capsys):
    class Fails(Formula):
        def worth(self, training):
            return None

        def heights(self, training):
            return {}

    search = searched(tmp_path / "it", spaced(RATE), 40, train=Fails())
    assert search.run() == 1
    assert 5 <= len(search._study.trials) <= 6
    assert re.search(r"error: the last \d trials failed; why: ", capsys.readouterr().out)


def test_a_trial_that_was_to_be_cut_when_the_search_was_killed_is_cut(tmp_path):
    space = spaced(RATE)
    first = searched(tmp_path / "it", space, 2)
    trial = first._study.ask(space.choices)
    trial.set_user_attr("cut", {"seed": 1, "step": 300, "of": 1000, "worth": 5.0})
    second = searched(tmp_path / "it", space, 2)
    assert second.run() == 0
    assert [trial.state.name for trial in second._study.trials] == ["PRUNED", "COMPLETE"]
    # No run was begun for it.
    assert len(second.trainings.jobs) == 1
    assert second.trainings.cuts == []


def test_a_run_that_another_trial_needs_goes_on(tmp_path):
    search = searched(tmp_path / "it", spaced("agent.q_lr=1e-3,1e-2"), 4, workers=4)
    assert search.look()
    first, second, *others = search._under_way
    for each in others:
        each.trainings = {}
    second.trainings = first.trainings
    search._cut(first, {"seed": 1, "step": 300, "of": 1000, "worth": 5.0})
    assert search.trainings.cuts == []
    search._under_way.remove(first)
    search._cut(second, {"seed": 1, "step": 300, "of": 1000, "worth": 5.0})
    assert len(search.trainings.cuts) == 1

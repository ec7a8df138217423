"""Searches that look at learning curves: against the episodes themselves, and as users start and kill them."""

import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from guides import ROOT
from searches import LENGTH, RATE, TINY, prepared, reports, start
from test_export import needs

from acmr.settings.compose import compose_config, parse
from analysis.statistics.metrics import area_under_curve

#: Optuna is an extra, which is there where the slow tests run.
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _optuna():
    needs("optuna")


@pytest.mark.parametrize("metric", ["final_return", "area", "steps_to_threshold"])
def test_what_a_curve_says_at_a_tenth_follows_from_the_episodes_up_to_there(metric):
    from acmr.app.tune.curve import first_judged, heights, step_of

    rng = np.random.default_rng(1)
    steps = np.cumsum(rng.integers(20, 60, 50))
    # One that ends at the step itself belongs to it.
    steps[np.searchsorted(steps, 600)] = 600
    config = replace(parse(compose_config(TINY)), total_timesteps=2000, threshold=9.0, consecutive=3)
    assert (config.most_steps, step_of(3, config), first_judged(config)) == (2000, 600, 3)
    assert first_judged(replace(config, agent=replace(config.agent, learning_starts=700))) == 5
    returns = rng.normal(5.0, 1.0, 50)
    returns[-12:] = 10.0
    frame = pd.DataFrame({"global_step": steps, "episodic_return": returns})
    whole = heights(frame, config, metric, ended=True)
    assert sorted(whole) == list(range(1, 11))
    reached = steps[40]
    for tenth, value in whole.items():
        before = steps <= 200 * tenth
        if metric == "final_return":
            assert value == pytest.approx(returns[before][-10:].mean())
        elif metric == "area":
            assert value == area_under_curve(steps[before], returns[before])
        elif 200 * tenth >= reached:
            assert value == reached
        else:
            lacking = 9.0 - returns[before][-10:].mean()
            assert value == pytest.approx(2000 * (1 + lacking / (9 + lacking)))
    # Whenever it is asked for, and whatever comes after.
    for count in range(51):
        found = heights(frame[:count], config, metric, ended=False)
        last = steps[count - 1] if count else 0
        assert found == {tenth: whole[tenth] for tenth in range(1, 10) if 200 * tenth <= last}
    nothing = heights(frame[:0], config, metric, ended=True)
    assert nothing == ({10: 4000.0} if metric == "steps_to_threshold" else {})


def test_a_search_cuts_a_run_lets_the_other_one_train_and_goes_on_after_a_kill(tmp_path):
    # A step costs, so that longer episodes have lower returns, whatever is learned: the search cuts them.
    folder = tmp_path / "runs" / "tune" / "it"
    prepared(folder, "final_return", -600.0, {LENGTH: 50}, {LENGTH: 150})
    tiny = [word for word in TINY if not word.startswith((LENGTH, "total_timesteps"))]
    words = (
        *tiny,
        "total_timesteps=2000",
        f"{LENGTH}=50,150",
        "study=it",
        "trials=7",
        "metric=final_return",
        "workers=2",
    )
    search = start(tmp_path, *words)
    while len(reports(folder)) < 1:
        assert search.poll() is None, search.communicate()
        time.sleep(0.05)
    search.send_signal(signal.SIGKILL)
    search.communicate()
    before = reports(folder)
    again = start(tmp_path, *words)
    said, errors = again.communicate(timeout=500)
    assert (again.returncode, errors) == (0, ""), said
    assert "going on: 5 trials have ended, 2 were under way" in said
    told = reports(folder)
    assert told[: len(before)] == before
    assert len(set(told)) == len(told)
    assert re.search(rf"trial 6: {LENGTH}=150  cut short: worse than the median at seed 1, step \d,?\d+ of 2,000", said)
    (short,) = tmp_path.glob("runs/quick/*=50-*/seed_1")
    (long,) = tmp_path.glob("runs/quick/*=150-*/seed_1")
    assert json.loads((short / "summary.json").read_text())["status"] == "complete"
    # It was stopped in good order: with a checkpoint, and can go on to its end.
    assert not (long / "summary.json").exists()
    assert json.loads((long / "status.json").read_text())["state"] == "stopped"
    step = json.loads((long / "status.json").read_text())["global_step"]
    assert 600 <= step < 2000
    assert "| 6 | 150 | 1 | " in (folder / "search.md").read_text()
    done = subprocess.run(
        [sys.executable, str(ROOT / "run.py"), *tiny, "total_timesteps=2000", f"{LENGTH}=150", "seed=1"],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    begun = re.search(r"seed 1: step ([\d,]+) of 2,000", done.stdout)
    assert begun is not None
    assert 0 < int(begun[1].replace(",", "")) <= step
    assert json.loads((long / "summary.json").read_text())["status"] == "complete"
    best = f"{LENGTH}=50"
    assert best in re.findall(r"^best: (.+)$", said, re.M)[0]


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

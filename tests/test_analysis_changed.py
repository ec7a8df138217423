"""Numbers that changed on disk enter no result without a word: the run is damaged, or what is not known is NaN."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
import yaml
from analysis_runs import realistic_rows, run_directory, seal, write_run
from numpy.random import default_rng

from analysis.analyze import analyze
from analysis.cli import main
from analysis.figures.data import training_speeds
from analysis.loading.load import load
from analysis.statistics.metrics import measure

TOTAL, THRESHOLD = 40_000, 3000.0
#: What differs from the rest of ``config.yaml`` is what the first episodes are judged by.
SETTINGS = Path(__file__).resolve().parent.parent / "results/paper/humanoid-none/seed_1/config.yaml"
SHOWN = ["steps_to_threshold", "initial_return", "asymptotic_return", "area_under_curve", "final_length", "horizon"]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for cell, half in (("A0", 20_000), ("A2", 12_000)):
        for seed in (1, 2):
            rows = realistic_rows(default_rng(seed), TOTAL, half, top=4500.0)
            said = {"steps_per_second": 100.0}
            write_run(tmp_path / "runs", cell, seed, rows, total=TOTAL, threshold=THRESHOLD, summary=said)
    return tmp_path / "runs"


def numbers(root: Path) -> pd.DataFrame:
    return measure(load(root), THRESHOLD, 5)


def changed(root: Path, change: Callable[[Path], None], sealed: bool = True) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Every number of the runs before and after one of them was changed."""
    folder = run_directory(root, "A2", 2)
    if sealed:
        seal(folder)
    before = numbers(root)
    change(folder)
    after = numbers(root)
    name = str(folder.relative_to(root))
    pd.testing.assert_frame_equal(before.drop(name), after.drop(name), check_dtype=False)
    return before.loc[name], after.loc[name]


def same(one: float, other: float) -> bool:
    return one == other or (math.isnan(one) and math.isnan(other))


def replaced(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def test_every_changed_digit_of_the_episodes_is_told(root):
    folder = run_directory(root, "A2", 2)
    text = (folder / "episodes.csv").read_text()
    seal(folder)
    digits = [place for place, letter in enumerate(text) if letter.isdigit()]
    for place in digits[:: len(digits) // 25]:
        digit = str((int(text[place]) + 3) % 10)
        (folder / "episodes.csv").write_text(text[:place] + digit + text[place + 1 :])
        found = load(root).runs.loc[str(folder.relative_to(root))]
        assert (found["state"], found["reason"], found["counted"]) == (
            "damaged", "episodes.csv was changed since the run ended", False,
        )  # fmt: skip


@pytest.mark.parametrize("column", [0, 2])
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_of_older_runs_steps_and_lengths_that_do_not_agree_are_told(column, root, capsys):
    def change(folder: Path) -> None:
        lines = (folder / "episodes.csv").read_text().splitlines()
        values = lines[-3].split(",")
        values[column] = str(int(values[column]) + 1)
        lines[-3] = ",".join(values)
        (folder / "episodes.csv").write_text("\n".join(lines) + "\n")

    _, after = changed(root, change, sealed=False)
    assert "an episode of" in after["reason"]
    assert main([str(root), "--summary"]) == 0
    assert "not all is known of armless_humanoid-hidden-frozen/seed_2: episodes.csv: line" in capsys.readouterr().out


@pytest.mark.parametrize("sealed", [True, False])
def test_settings_cut_off_at_any_line_tell_no_other_initial_return(sealed, root):
    folder = run_directory(root, "A2", 2)
    own = yaml.safe_load((folder / "config.yaml").read_text())
    whole = yaml.safe_load(SETTINGS.read_text())
    whole = {key: own.get(key, value) for key, value in whole.items() if key != "tracking"}
    whole["agent"] = {**whole["agent"], "learning_starts": 3000, "start": "random"}
    text = yaml.safe_dump(whole, sort_keys=False)
    (folder / "config.yaml").write_text(text)
    if sealed:
        seal(folder)
    name, before = str(folder.relative_to(root)), numbers(root)
    lines, told = text.splitlines(keepends=True), 0
    for count in range(len(lines)):
        (folder / "config.yaml").write_text("".join(lines[:count]))
        after = numbers(root)
        pd.testing.assert_frame_equal(before.drop(name), after.drop(name), check_dtype=False)
        one, other = before.loc[name], after.loc[name]
        if not count and not sealed:
            assert (other["state"], other["reason"]) == ("damaged", "config.yaml: holds no settings")
            continue
        assert other["counted"], other["reason"]
        assert all(same(one[key], other[key]) or math.isnan(other[key]) for key in SHOWN)
        if not same(one["initial_return"], other["initial_return"]):
            told += 1
            assert "its initial return is not" in other["doubts"]
    assert told > len(lines) // 2


@pytest.mark.parametrize("sealed", [True, False])
@pytest.mark.first_is_fast
def test_settings_that_are_gone_leave_the_initial_return_unknown(sealed, root, capsys):
    before, after = changed(root, lambda folder: (folder / "config.yaml").unlink(), sealed)
    assert (after["counted"], after["state"]) == (True, "complete")
    assert before["initial_return"] > 0
    assert math.isnan(after["initial_return"])
    assert after["steps_to_threshold"] == before["steps_to_threshold"]
    assert main([str(root), "--summary"]) == 0
    said = capsys.readouterr().out
    assert "not all is known of armless_humanoid-hidden-frozen/seed_2: " in said
    assert ("config.yaml is missing" in said) == sealed


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("summary.json", '"global_step": 40000', '"global_step": 30000'),
        ("summary.json", '"seed": 2', '"seed": 7'),
        ("summary.json", '"files"', '"fi1es"'),
        ("summary.json", '"sha256": ', '"sha255": '),
        ("summary.json", '"cell": "A2"', '"cell": "A0"'),
        ("episodes.csv", "\n", "\n\n"),
    ],
)
def test_a_summary_or_table_that_was_changed_leaves_a_damaged_run(name, old, new, root):
    _, after = changed(root, replaced(name, old, new))
    assert (after["state"], after["counted"]) == ("damaged", False)
    assert name in after["reason"]
    # Its directory says what it was.
    assert (after["cell"], after["seed"]) == ("A2", 2)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("config.yaml", "learning_starts: 200", "learning_starts: 900"),
        ("config.yaml", "q_lr: 0.001", "q_lr: 0.007"),
        ("config.yaml", "agent:", "agent: ["),
        ("config.yaml", "seed: 2", "seed: 3"),
    ],
)
def test_settings_that_were_changed_are_not_used(name, old, new, root):
    before, after = changed(root, replaced(name, old, new))
    assert (after["counted"], after["steps_to_threshold"]) == (True, before["steps_to_threshold"])
    assert math.isnan(after["initial_return"])
    assert "config.yaml was changed since" in after["doubts"] or "config.yaml has" in after["doubts"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"threshold": 3000.0', '"threshold": 3900.0', "threshold 3900.0, config.yaml threshold 3000.0"),
        ('"seed": 2', '"seed": 1', "seed 1, config.yaml seed 2"),
        ('"profile": "paper"', '"profile": "quick"', "profile quick, config.yaml profile paper"),
        ('"total_timesteps": 40000', '"total_timesteps": 90000', "total_timesteps 90000, config.yaml"),
        ('"freeze": true', '"freeze": false', "freeze False, config.yaml freeze True"),
        ('"env": "armless_humanoid"', '"env": "humanoid"', "env humanoid, config.yaml env armless_humanoid"),
    ],
)
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_older_runs_whose_files_contradict_each_other_are_damaged(old, new, said, root, capsys):
    _, after = changed(root, replaced("summary.json", old, new), sealed=False)
    assert (after["state"], after["counted"], after["cell"], after["seed"]) == ("damaged", False, "A2", 2)
    assert f"summary.json says {said}" in after["reason"]
    assert main([str(root), "--summary"]) == 0
    assert f"summary.json says {said}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "change",
    [
        replaced("metrics.csv", "112", "999"),
        lambda folder: (folder / "metrics.csv").unlink(),
        lambda folder: (folder / "metrics.csv").write_text("global_step,steps_per_second\n100,5\n"),
    ],
)
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_of_changed_metrics_no_speed_is_shown(change, root):
    seal(run_directory(root, "A2", 2))
    data = analyze(load(root)).measured
    name = str(run_directory(root, "A2", 2).relative_to(root))
    assert name in set(training_speeds(root, data, ["A2"])["run"])
    change(run_directory(root, "A2", 2))
    analysis = analyze(load(root))
    speeds = training_speeds(root, analysis.measured, ["A2"])
    assert set(speeds["run"]) == {name.replace("seed_2", "seed_1")}
    assert analysis.measured.loc[name, "counted"]
    assert "metrics.csv" in analysis.doubts[0]
    assert analysis.doubts[0] in analysis.notices


def test_a_run_of_ours_is_not_taken_for_a_foreign_one(root):
    def change(folder: Path) -> None:
        (folder / "status.json").write_text(json.dumps({"state": "stopped", "global_step": 9, "total_timesteps": 10}))
        for name in ("config.yaml", "summary.json"):
            (folder / name).unlink()

    _, after = changed(root, change)
    assert (after["state"], after["counted"]) == ("unfinished", False)

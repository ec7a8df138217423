"""The page of the benchmark of structural shifts, against hand calculation on runs that are laid out here."""

from __future__ import annotations

import csv
import gzip
import json
import math
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from acmr.cells import CELLS, run_name
from acmr.evaluation import rollout
from acmr.records import steps_to_threshold
from acmr.settings.compose import environment_config
from acmr.settings.sources import SWEEPS, Sources
from acmr.transfer.teacher import load_teacher
from analysis.loading.load import load
from analysis.publish import publish
from analysis.statistics.two_samples import permutation_p
from docs.shifts import play
from docs.shifts.figures import binned, figures
from docs.shifts.pilots import level, pilots, threshold
from docs.shifts.runs import ZERO_SHOT, Benchmark, read
from docs.shifts.tables import PAGE, compared, filled, scores, tables

ROOT = Path(__file__).resolve().parent.parent
#: Steps of a run, and its threshold.
BUDGET, THRESHOLD = 10_000, 200.0
LOST, ADDED, WHOLE = "hopper_sensors_failed", "hopper_sensors_added", "whole_hopper"


def write(root: Path, env: str, method: str, seed: int, met: int | None, early: float = 10.0) -> Path:
    """A run with episodes of 100 steps, of which the fifth at the threshold ends at a step."""
    cell = CELLS[method]
    folder = root / run_name(env, cell.transfer, cell.freeze, cell.changes) / f"seed_{seed}"
    folder.mkdir(parents=True)
    config = {
        "seed": seed, "freeze": cell.freeze, "total_timesteps": BUDGET, "threshold": THRESHOLD, "consecutive": 5,
        "profile": "shifts", "pair": {"source": "none", "target": "none"}, "env": asdict(environment_config(env)),
        "agent": {"learning_starts": 100}, "transfer": {"name": cell.transfer, "impute": "mean"},
    }  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    ends = range(100, BUDGET + 1, 100)
    returns = [THRESHOLD + 0.25 if met is not None and end > met - 500 else early + end / 1e7 for end in ends]
    lines = [f"{end},{value!r},100,1.5" for end, value in zip(ends, returns, strict=True)]
    header = "global_step,episodic_return,episode_length,mean_forward_velocity"
    (folder / "episodes.csv").write_text("\n".join([header, *lines]) + "\n")
    (folder / "metrics.csv").write_text("global_step,steps_per_second\n1000,500.0\n")
    summary = {
        "status": "complete", "cell": None, "run": folder.parent.name, "profile": "shifts", "env": env,
        "transfer": cell.transfer, "freeze": cell.freeze, "seed": seed, "global_step": BUDGET,
        "total_timesteps": BUDGET, "stop": "horizon", "stop_after": None, "episodes": len(lines),
        "threshold": THRESHOLD, "consecutive": 5, "steps_to_threshold": met, "machine": {"processor": "a core"},
    }  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


#: Steps to threshold of ten seeds of each method; the interquartile mean is that of the six in the middle.
STEPS = {
    "A0": [6000, 6100, 6200, 6300, 6400, 6500, 6600, 6700, None, None],
    "A2": [6000, 6100, 6200, 6300, 6400, 6500, 6600, 6700, None, None],
    "A3": [None] * 10,
    "N0": [3000, 6000, 6200, 6200, 6400, 6400, 6600, 6600, 9000, None],
    "N1": [1000, 1100, 1200, 1300, 1400, 1600, 1700, 1800, 1900, 2000],
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both pairs of the Hopper; the one that gains its sensors has three seeds, and no baseline under its own name."""
    root = tmp_path_factory.mktemp("runs") / "shifts"
    for method, told in STEPS.items():
        for seed, met in enumerate(told, start=1):
            write(root, LOST, method, seed, met, early=110.0 if method == "N1" else 10.0)
    # The last is a pilot, and none of what is told.
    for seed in (1, 2, 3, 101):
        write(root, WHOLE, "A0", seed, 4000 + 100 * seed if seed < 100 else 1000)
    for seed in (1, 2, 3):
        write(root, ADDED, "N1", seed, 1000)
    with (root / ZERO_SHOT).open("w") as file:
        rows = [[LOST, method, seed, 10, 10.0] for method in STEPS for seed in range(1, 11)]
        csv.writer(file).writerows([["pair", "method", "seed", "episodes", "mean_return"], *rows])
    return root


@pytest.fixture(scope="module")
def found(root: Path) -> Benchmark:
    return read(root)


@pytest.fixture(scope="module")
def beside(found: Benchmark) -> pd.DataFrame:
    """The comparisons, whose exact tests take a second each."""
    return compared(found)


def test_a_run_is_measured_as_by_hand(found):
    assert (found.pairs, found.whole) == ([LOST, ADDED], [LOST])
    first, last = found.of(LOST, "A0").iloc[[0, -1]].to_dict("records")
    assert (first["steps"], first["reached"], last["steps"], last["reached"]) == (6000.0, True, 10_000.0, False)
    # Five episodes end from step 501 to step 1000.
    assert first["early"] == pytest.approx(10 + np.mean([600, 700, 800, 900, 1000]) / 1e7, rel=1e-9)
    assert (first["final"], first["zero_shot"]) == (THRESHOLD + 0.25, 10.0)


def test_the_baseline_of_a_body_that_gets_back_what_it_lost_is_its_teachers_teacher(found, tmp_path):
    assert list(found.of(ADDED, "A0")["run"]) == [f"{WHOLE}-none/seed_{seed}" for seed in (1, 2, 3)]
    # Where it was trained under its own name, that is it.
    for seed in (1, 2):
        write(tmp_path, WHOLE, "A0", seed, 4000)
        write(tmp_path, ADDED, "N1", seed, 1000)
    write(tmp_path, ADDED, "A0", 2, 4000)
    assert list(read(tmp_path).of(ADDED, "A0")["run"]) == [f"{WHOLE}-none/seed_1", f"{ADDED}-none/seed_2"]


def test_methods_are_compared_as_by_hand(beside):
    told = beside.set_index(["pair", "method"])
    base = [10_000 if met is None else met for met in STEPS["A0"]]
    assert list(told.loc[LOST].index) == ["A2", "A3", "N0", "N1"]
    # Each run of A0 meets ten of N0: from the first on so many of them are faster, and a tie is half.
    faster = [sum((a > n) + (a == n) / 2 for n in (m or 10_000 for m in STEPS["N0"])) for a in base]
    assert told.loc[(LOST, "N0"), "faster"] == pytest.approx(sum(faster) / 100)
    assert (told.loc[(LOST, "A2"), "faster"], told.loc[(LOST, "N1"), "faster"]) == (0.5, 1.0)
    assert told.loc[(LOST, "A3"), "faster"] == pytest.approx((2 * 10 / 2) / 100)
    least = 2 / math.comb(20, 10)
    assert told.loc[(LOST, "N1"), "p"] == pytest.approx(least)
    # Five rows: four of the one pair, one of the other, whose three and three can give no p below a tenth.
    assert told.loc[(LOST, "N1"), "p_holm"] == pytest.approx(5 * least)
    assert told.loc[(ADDED, "N1"), "p"] == pytest.approx(0.1)
    assert told.loc[(LOST, "N0"), "p"] == permutation_p(base, [met or 10_000 for met in STEPS["N0"]])


def test_scales_are_those_that_the_page_tells(found):
    (steps,), (early,) = scores(found, "N1", "steps"), scores(found, "N1", "early")
    assert steps.tolist() == [met / BUDGET for met in STEPS["N1"]]
    # 0 is the untrained 10, 1 the threshold of 200; the fastest has it in the window.
    assert early[-1] == pytest.approx(100 / 190, abs=1e-3)
    assert early[0] == pytest.approx((np.mean([200.25] * 5) - 10) / 190)


def test_tables_tell_the_numbers(found, beside, monkeypatch):
    monkeypatch.setattr("docs.shifts.tables.compared", lambda same: beside)
    told = tables(found)
    rows = {tuple(line.split(" | ")[:2]): line for line in told["shifts pairs"].splitlines()[2:]}
    line = rows[f"| {LOST}", "by name, best start"]
    # The six in the middle: 1200, 1300, 1400, 1600, 1700, 1800.
    assert "| 10 of 10 | 1,500 (" in line
    assert line.endswith("1.00 (1.00 to 1.00) | < 0.001 |")
    assert "| 0 of 10 | 10,000 (10,000 to 10,000) |" in rows[f"| {LOST}", "expanded"]
    assert "| 3 of 3 | 1,000 |" in rows[f"| {ADDED}", "by name, best start"]
    assert told["shifts overall"].startswith(f"1 pair: {LOST}.")
    assert "| by name, best start | 10 | 0.15 (" in told["shifts overall"]
    assert f"- `{ADDED}`, by name, best start: seeds 4, 5, 6, 7, 8, 9, 10" in told["shifts missing"]
    assert LOST not in told["shifts missing"]


def test_the_published_runs_tell_the_same_in_a_few_kilobytes(root, found, tmp_path):
    out = tmp_path / "results" / "shifts"
    done = publish(root, out, small=True)
    assert len(done.added) == 57
    (out / ZERO_SHOT).write_bytes((root / ZERO_SHOT).read_bytes())
    ours, theirs = (each.runs.drop(columns="run") for each in (read(out), found))
    pd.testing.assert_frame_equal(ours, theirs, rtol=1e-7)
    assert not [reason for reason in load(out).runs["reason"] if reason]
    folder = out / f"{LOST}-none" / "seed_1"
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "summary.json", "episodes.csv.gz"}
    assert gzip.decompress((folder / "episodes.csv.gz").read_bytes()).splitlines()[:2] == [
        b"global_step,episodic_return,episode_length",
        b"100,10.00001,100",
    ]
    # Once more there is nothing to add.
    assert not publish(root, out, small=True).added


def test_figures_show_every_method(found):
    drawn = dict(figures(found))
    assert set(drawn) == {"curves", "profiles"}
    panel = drawn["profiles"].axes[0]
    shares = [line.get_ydata() for line in panel.get_lines()]
    assert len(shares) == 5
    # A tenth of N1's runs is at the threshold by a tenth of the budget, all of them by a fifth; of A0 eight ever are.
    assert (shares[4][10], shares[4][20], shares[0][60], shares[0][100]) == (0.1, 1.0, 0.1, 0.8)
    ends, runs = binned(found, found.of(LOST, "N1"))
    assert ends.tolist() == [2000, 4000, 6000, 8000, 10_000]
    assert runs.shape == (10, 5)
    assert runs[0, 1] == THRESHOLD + 0.25


def test_a_folder_without_runs_has_a_page(tmp_path):
    told = tables(read(tmp_path))
    assert told["shifts pairs"] == "There are no runs yet."
    assert not dict(figures(read(tmp_path)))


def test_level_is_the_highest_threshold_that_was_met_in_time():
    steps, returns = list(range(10, 90, 10)), [5.0, 9.0, 7.0, 8.0, 6.0, 9.0, 9.0, 9.0]
    for until in (50, 60, 80):
        reached = level(steps, returns, until, consecutive=3)
        assert steps_to_threshold(steps, returns, reached, 3).last <= until
        above = steps_to_threshold(steps, returns, np.nextafter(reached, np.inf), 3)
        assert above is None or above.last > until
    assert [level(steps, returns, until, 3) for until in (20, 50, 80)] == pytest.approx([math.nan, 7, 9], nan_ok=True)


@pytest.mark.parametrize(("levels", "told"), [([1, 299.9, 500], 290), ([1239.0] * 3, 1200), ([12.0, 13, 99], 13)])
def test_a_threshold_is_the_median_level_rounded_down_to_two_digits(levels, told):
    assert threshold(levels) == told


def test_thresholds_are_those_of_the_pilots_and_the_matrix_has_the_pairs_whose_bodies_have_one():
    settled = {body: threshold(levels) for body, levels in pilots().items() if len(levels) == 3}
    said = {path.stem: yaml.safe_load(path.read_text()) for path in (ROOT / "conf" / "env").glob("*.yaml")}
    assert {name: content["threshold"] for name, content in said.items() if "threshold" in content} == settled
    matrix = yaml.safe_load((ROOT / "sweeps" / "matrix" / "shifts.yaml").read_text())
    for pair in matrix["hydra"]["sweeper"]["params"]["env"].replace(" ", "").split(","):
        config = environment_config(pair)
        bodies = {pair if pair in settled else environment_config(config.source).source, config.source}
        assert bodies <= settled.keys()


@pytest.mark.slow
def test_the_page_is_what_its_command_prints():
    assert PAGE.read_text() == filled(read(ROOT / "results" / "shifts")), "type python -m docs.shifts"


@pytest.mark.slow
def test_before_learning_a_student_that_gained_sensors_is_its_teacher(tmp_path, monkeypatch):
    """The whole way of the benchmark with runs of 300 steps: trained, played, published, told."""
    shutil.copytree(ROOT / "conf", tmp_path / "conf")
    profile = tmp_path / "conf" / "profile" / "shifts.yaml"
    changed = profile.read_text().replace("80000", "300").replace("learning_starts: 2000", "learning_starts: 200")
    profile.write_text(changed.replace("[64, 64]", "[8, 8]"))
    words = ["--config-path", str(tmp_path / "conf"), "profile=shifts", f"env={ADDED}", "experiment=A0,N0,N1"]
    command = [sys.executable, "run.py", "-m", *words, "tracking=off", "workers=1", f"output_dir={tmp_path / 'runs'}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    monkeypatch.setattr("acmr.settings.compose._given", Sources((f"file://{tmp_path / 'conf'}", SWEEPS)))
    runs, out = tmp_path / "runs" / "shifts", tmp_path / "results" / "shifts"
    monkeypatch.setattr(sys, "argv", ["play", str(runs), str(out)])
    play.main()
    played = {row["method"]: float(row["mean_return"]) for row in csv.DictReader((out / ZERO_SHOT).open())}
    teacher = load_teacher(runs / f"{LOST}-none" / "seed_1").build_networks().actor.eval()
    config = environment_config(LOST)
    told = rollout.play(teacher, config, {}, episodes=play.EPISODES, seed=play.FIRST_SEED, stochastic=True)
    expected = round(np.mean([episode.episodic_return for episode in told]), 2)
    assert played.keys() == {"A0", "N0", "N1"}
    assert (played["N0"], played["N1"]) == (expected, expected) != played["A0"]
    publish(runs, out, small=True)
    assert sorted(path.parent.parent.name for path in out.glob("*/*/*.safetensors")) == [
        f"{LOST}-none",
        f"{WHOLE}-none",
    ]
    assert sum(path.stat().st_size for path in out.glob("*/*/*")) < 100_000
    assert list(read(out).of(ADDED, "N1")["zero_shot"]) == [played["N1"]]

"""The analysis of a folder of runs of which one was changed: it ends, says so, and no other run's number changes.

``make mutations`` tries 5,000 changes, CI 500; ``ACMR_MUTATIONS=COUNT`` and ``ACMR_SEED=NUMBER`` choose others.
"""

from __future__ import annotations

import gc
import json
import os
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import pytest
from analysis_runs import realistic_rows, run_directory, seal, write_cut, write_run
from mutations import Mutation, mutations
from numpy.random import default_rng

from acmr.names import terminal
from acmr.run_folders import run_folders
from analysis.analyze import analyze
from analysis.cli import main
from analysis.figures.data import training_speeds
from analysis.loading.load import load
from analysis.loading.missing import matrix_command, missing_runs
from analysis.loading.setting_differences import setting_differences
from analysis.report.terminal import left_out_lines, missing_lines, print_summary
from analysis.statistics.metrics import measure
from sweeps.status import main as status

COUNT, SEED = int(os.environ.get("ACMR_MUTATIONS", "500")), int(os.environ.get("ACMR_SEED", "0"))
PARTS = 10
TOTAL, THRESHOLD = 20_000, 3000.0
#: Seconds that one analysis may take.
LONGEST = 30
#: Numbers of a run that enter tables and figures.
NUMBERS = (
    "seed", "steps_to_threshold", "steps_to_threshold_first", "time", "watched", "horizon", "initial_return",
    "asymptotic_return", "area_under_curve", "final_length", "final_velocity", "episodes", "last_step", "wall_seconds",
    "steps_per_second", "total_timesteps", "stop_after",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of each kind: sealed, older, stopped at the threshold, diverged, under way, foreign."""
    root = tmp_path_factory.mktemp("mutations") / "paper"
    for cell, half in (("A0", 9_000), ("A2", 6_000)):
        for seed in (1, 2, 3):
            rows = realistic_rows(default_rng(seed), TOTAL, half, top=4500.0)
            summary = {"status": "diverged", "cause": "a loss is not finite", "step": TOTAL} if seed == 3 else True
            said = {"total": TOTAL, "threshold": THRESHOLD, "summary": summary}
            path = write_run(root, cell, seed, rows, **said)
            # Of each cell one run is older than the digests.
            if seed != 2:
                seal(path)
    rows = realistic_rows(default_rng(4), TOTAL, 7_000, top=4500.0)
    seal(write_cut(root, "A1", 1, rows, TOTAL, threshold=THRESHOLD))
    waiting = write_run(root, "A1", 2, rows[:20], total=TOTAL, threshold=THRESHOLD, summary=False)
    said = {"state": "running", "global_step": int(rows[20, 0]), "total_timesteps": TOTAL}
    (waiting / "status.json").write_text(json.dumps(said | {"latest_return": 1.5, "process": 1, "host": "elsewhere"}))
    foreign = run_directory(root, "A4", 1)
    foreign.mkdir(parents=True)
    shutil.copy(run_directory(root, "A0", 1) / "episodes.csv", foreign)
    return root


@contextmanager
def limit() -> Iterator[None]:
    """Ends what hangs."""

    def ring(number: int, frame: object) -> None:
        raise RuntimeError(f"not done within {LONGEST} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(LONGEST)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def numbers(root: Path) -> pd.DataFrame:
    runs = measure(load(root), THRESHOLD, 5)
    groups = list(dict.fromkeys(runs["group"]))
    return runs.assign(speed=training_speeds(root, runs, groups).groupby("run")["steps_per_second"].mean())


def said(root: Path) -> None:
    """All that the analysis says of a folder, but for what takes seconds."""
    data = load(root)
    analysis = analyze(data, THRESHOLD, 5)
    print_summary(analysis.cells, analysis.comparisons, "all")
    lines = missing_lines(missing_runs(data), 21, matrix_command(data))
    print(*map(terminal, [*analysis.notices, *left_out_lines(analysis.measured), *lines]), sep="\n")
    setting_differences(data)
    assert all(map(terminal, data.pair))


def same(one: object, other: object) -> bool:
    return one == other or (pd.isna(one) and pd.isna(other))


def problems(before: pd.DataFrame, after: pd.DataFrame, mutation: Mutation, sealed: bool) -> Iterator[str]:
    for name in before.index.drop(mutation.run):
        if name not in after.index:
            yield f"{name} is gone"
            continue
        one, other = before.loc[name], after.loc[name]
        keys = (*NUMBERS, "state", "reason", "doubts", "cell", "group")
        changed = [key for key in keys if not same(one[key], other[key])]
        # Of a group without a run that counts one under way is drawn.
        changed += (
            ["speed"]
            if not same(one["speed"], other["speed"]) and pd.notna([one["speed"], other["speed"]]).all()
            else []
        )
        if changed:
            yield f"{name}: {changed}: {list(before.loc[name, changed])} -> {list(after.loc[name, changed])}"
    if mutation.run not in after.index:
        yield "the run itself is not listed"
        return
    old, new = before.loc[mutation.run], after.loc[mutation.run]
    told = any(new[key] not in ("", old[key]) for key in ("reason", "doubts")) or new["state"] != old["state"]
    changed = [key for key in (*NUMBERS, "speed") if not same(old[key], new[key])]
    if sealed and changed and not told:
        yield f"{changed}: {list(old[changed])} -> {list(new[changed])} without a word"


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_one_changed_run_is_one_changed_run(part, folder, tmp_path, capsys):
    before = numbers(folder)
    runs = list(before.index)
    is_sealed = {run: _is_sealed(folder / run) for run in runs}
    assert sorted(is_sealed.values()) == [False] * 4 + [True] * 5
    root, found = tmp_path / "paper", []
    # Libraries collect garbage in between, which takes longer than all else where there is much to look through.
    gc.freeze()
    shutil.copytree(folder, root)
    for number, mutation in enumerate(mutations(folder, runs, COUNT, SEED)):
        if number % PARTS != part:
            continue
        mutation.apply(root / mutation.run)
        what = f"{mutation.run}: {mutation.name}"
        try:
            with limit():
                after = numbers(root)
                found += [
                    f"{what}: {problem}" for problem in problems(before, after, mutation, is_sealed[mutation.run])
                ]
                if number % 4 == 0:
                    said(root)
                # The program as a whole takes seconds.
                if number % 200 == part and main([str(root), "--summary", "--threshold", str(THRESHOLD)]) != 0:
                    found.append(f"{what}: analysis: {capsys.readouterr().err}")
                if number % 5 == 1 and status([str(root.parent)]) not in (0, 1):
                    found.append(f"{what}: status: {capsys.readouterr().err}")
                capsys.readouterr()
        except Exception as error:
            found.append(f"{what}: {type(error).__name__}: {str(error)[:200]}")
        shutil.rmtree(root / mutation.run)
        shutil.copytree(folder / mutation.run, root / mutation.run)
    assert not found, "\n".join(found[:40]) + f"\n{len(found)} in all"
    assert len(run_folders(root)) == len(runs)


def _is_sealed(run: Path) -> bool:
    path = run / "summary.json"
    return path.exists() and "sha256" in json.loads(path.read_text())


def test_the_changes_are_the_same_for_the_same_seed_and_many(folder):
    runs = [str(run.path.relative_to(folder)) for run in run_folders(folder)]
    made = [(mutation.run, mutation.name) for mutation in mutations(folder, runs, 5000)]
    assert made == [(mutation.run, mutation.name) for mutation in mutations(folder, runs, 5000)]
    assert len(made) == 5000
    assert len(set(made)) > 4900
    for kind in ("cut after line", "without (", "= 'nan'", "a pipe", "flip", "digit", "line_twice"):
        assert sum(kind in name for _, name in made) > 10, kind

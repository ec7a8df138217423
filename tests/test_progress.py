"""Progress, as a user sees it: in a real pseudoterminal, in a file, and in terminals of every width."""

from __future__ import annotations

import io
import os
import pty
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from acmr.config import ExperimentConfig
from acmr.records import EpisodeRecord
from acmr.settings.run_spec import RunSpec
from acmr.tracking.observer import Observer
from acmr.tracking.progress import BarProgress, LineProgress, RunProgress, make_progress

ROOT = Path(__file__).resolve().parents[1]
NAME = "A2 armless_humanoid-hidden-frozen seed 1"

#: Prints, logs through a handler that was made before the bar, and writes to standard error, all over a live bar.
NOISY_RUN = """
import logging, sys, time
logging.basicConfig(stream=sys.stdout, level=logging.INFO, format="%(message)s")
from acmr.config import ExperimentConfig
from acmr.records import EpisodeRecord
from acmr.settings.run_spec import RunSpec
from acmr.tracking.progress import make_progress
progress = make_progress(RunSpec(ExperimentConfig(total_timesteps=3000, threshold=900), {}, "ant", "A2", "ant"))
for step in range(1, 3001):
    progress.on_step(step)
    if step % 500 == 0:
        progress.on_episode(EpisodeRecord(step, float(step), 500))
        logging.info("logged at %d", step)
        print("printed at", step)
        print("warned at", step, file=sys.stderr)
    time.sleep(0.0005 if step % 3 == 0 else 0)
progress.close(None)
logging.info("logged after")
"""


def spec(total: int = 1000, threshold: float = 900.0, consecutive: int = 5, **more: Any) -> RunSpec:
    config = ExperimentConfig(total_timesteps=total, threshold=threshold, consecutive=consecutive, **more)
    return RunSpec(config, {}, "armless_humanoid-hidden-frozen", "A2", "armless_humanoid-hidden-frozen")


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def episode(step: int, value: float) -> EpisodeRecord:
    return EpisodeRecord(step, value, 100)


def screen(written: str) -> list[str]:
    """What a terminal shows of it: line feeds, returns, erased lines and upward moves."""
    lines, row, column = [""], 0, 0
    for token in re.findall(r"\x1b\[[0-9;?]*[A-Za-z]|[\s\S]", written):
        if token == "\n":
            row += 1
            lines += [""] * (row + 1 - len(lines))
        elif token == "\r":
            column = 0
        elif token == "\x1b[2K":
            lines[row] = ""
        elif token.startswith("\x1b[") and token.endswith("A"):
            row -= int(token[2:-1] or 1)
        elif not token.startswith("\x1b"):
            lines[row] = lines[row][:column].ljust(column) + token + lines[row][column + 1 :]
            column += 1
    return [line.rstrip() for line in lines]


def in_terminal(program: str, columns: int) -> list[str]:
    parent, child = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": str(columns), "LINES": "24", "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=child, stdout=child, stderr=child, env=environment, cwd=ROOT
    )
    os.close(child)
    written = b""
    while True:
        try:
            part = os.read(parent, 65536)
        except OSError:
            break
        if not part:
            break
        written += part
    os.close(parent)
    assert process.wait(timeout=30) == 0, written.decode()
    return screen(written.decode())


@pytest.mark.parametrize("columns", [60, 140])
def test_lines_in_between_do_not_tear_the_bar(columns: int) -> None:
    lines = in_terminal(NOISY_RUN, columns)
    steps = range(500, 3001, 500)
    expected = [f"{verb} at {step}" for step in steps for verb in ("logged", "printed", "warned")]
    bars = [line for line in lines if "100%" in line]
    assert [line for line in lines if line and "%" not in line] == [*expected, "logged after"]
    assert len(bars) == 1
    assert len([line for line in lines if "%" in line]) == 1
    assert len(bars[0]) < columns
    assert "return 3,000" in bars[0]
    assert ("steps/s" in bars[0]) is (columns == 140)
    assert ("A2 ant seed 1" in bars[0]) is (columns == 140)


def test_lines_without_a_terminal() -> None:
    done = subprocess.run(
        [sys.executable, "-c", NOISY_RUN], capture_output=True, text=True, cwd=ROOT, env={**os.environ, "TERM": "xterm"}
    )
    assert done.returncode == 0
    assert "\x1b" not in done.stdout
    own = [line for line in done.stdout.splitlines() if line.startswith("A2 ant seed 1: step")]
    assert own[0] == "A2 ant seed 1: step 0 of 3,000, threshold 900"
    assert own[-1].startswith("A2 ant seed 1: step 3,000 of 3,000 (100%), ")
    assert len(own) == 2


def test_a_line_a_minute_with_the_recent_speed_and_the_time_left() -> None:
    clock, lines = Clock(), list[str]()
    progress = LineProgress(spec(100_000), say=lines.append, clock=clock)
    for step in range(1, 20_001):  # 10 s of random steps, then learning, 20 times slower
        clock.now += 0.001 if step <= 10_000 else 0.02
        progress.on_step(step)
    assert len(lines) == 1 + 3  # 210 s
    assert progress.steps_per_second == pytest.approx(50, rel=0.02)
    assert progress.seconds_left is not None
    assert progress.seconds_left == pytest.approx(80_000 / 50, rel=0.02)
    assert re.fullmatch(NAME + r": step 18,5.. of 100,000 \(19%\), 50 steps/s, 27:\d\d left, no episode yet", lines[-1])
    progress.close(None)
    assert "20,000 of 100,000" in lines[-1]
    assert "3:30 in all" in lines[-1]


def test_a_resumed_run_counts_its_own_steps_only() -> None:
    clock = Clock()
    progress = RunProgress(spec(), start_step=900, clock=clock)
    for step in range(901, 951):
        clock.now += 1.0
        progress.on_step(step)
    assert progress.steps_per_second == pytest.approx(1.0)
    assert progress.seconds_left == pytest.approx(50, abs=1)


def test_standing_follows_the_returns() -> None:
    progress = RunProgress(spec(10_000, consecutive=3))
    assert progress.standing() == "no episode yet"
    seen = []
    for index, value in enumerate([712.4, 950.0, float("nan"), 901.0, 900.0, 1234.0, 10.0]):
        progress.on_episode(episode(1000 * (index + 1), value))
        seen.append(progress.standing())
    assert seen == [
        "return 712, 188 below 900",
        "return 950, 1/3 above 900",
        "return nan, nan below 900",
        "return 901, 1/3 above 900",
        "return 900, 2/3 above 900",
        "return 1,234, 900 reached at 6,000",
        "return 10, 900 reached at 6,000",
    ]


def bar(columns: int, **more: Any) -> tuple[BarProgress, Callable[[], str]]:
    """A bar on a terminal of this width, and what stands there."""
    written = io.StringIO()
    terminal = Console(file=written, force_terminal=True, width=columns, color_system=None)

    def shown() -> str:
        (line,) = filter(None, screen(written.getvalue()))
        return line

    return BarProgress(spec(**more), console=terminal), shown


@pytest.mark.parametrize("columns", range(31, 200, 4))
def test_the_bar_gives_way_to_what_matters_more(columns: int) -> None:
    progress, shown = bar(columns, total=1_000_000, threshold=4900.0)
    progress.on_step(500_000)
    progress.on_episode(episode(500_000, 712.0))
    progress.close(None)
    assert len(shown()) < columns
    assert " 50%" in shown()
    least = {"return 712, 4,188 below 4,900": 35, "ETA": 60, "steps/s": 96, "\u2501": 96, "seed 1": 151}
    for words, width in least.items():
        assert (words in shown()) or columns < width


def test_a_run_that_may_stop_before_its_last_step_says_so() -> None:
    clock, lines = Clock(), list[str]()
    progress = LineProgress(spec(consecutive=1, stop="threshold"), say=lines.append, clock=clock)
    for step in range(1, 101):
        clock.now += 1.0
        progress.on_step(step)
    assert lines[0] == f"{NAME}: step 0 of 1,000, threshold 900, where it stops"
    assert ", at most 15:40 left, no episode yet" in lines[1]


@pytest.mark.parametrize(("stop", "says"), [("threshold", "took 0 s"), ("horizon", "ETA")])
def test_the_bar_of_a_run_that_stopped_is_at_its_end(stop: str, says: str) -> None:
    progress, shown = bar(120, consecutive=1, stop=stop)
    assert "ETA" in shown()
    progress.on_step(10)
    progress.on_episode(episode(10, 950.0))
    progress.close(None)
    assert says in shown()


def test_a_step_costs_next_to_nothing() -> None:
    progress = RunProgress(spec(1_000_000))
    before = time.thread_time()
    for step in range(1, 200_001):
        progress.on_step(step)
    per_step = (time.thread_time() - before) / 200_000
    assert per_step < 0.01 / 3000  # one percent at 3,000 steps per second


def test_modes() -> None:
    kinds = {"bar": BarProgress, "lines": LineProgress, "off": Observer}
    for mode, kind in kinds.items():
        progress = make_progress(spec(progress=mode))
        progress.close(None)
        assert type(progress) is kind

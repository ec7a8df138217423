"""The table of runs in terminals of any width, and in pipes."""

import fcntl
import io
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.text import Text
from test_sweeps_status import ended, heartbeat

from acmr.records import COMPLETE, FAILED, RUNNING
from acmr.text import shorten
from sweeps.screen.table import reasons, run_table
from sweeps.state import WAITING
from sweeps.view import BLOCKED, LOST, RunStatus

RATES = [f"ant_three_legs-none-hidden_sizes=16+16-q_lr={rate}-total_timesteps=1000000" for rate in ("1e-05", "0.0003")]
RATES += [RATES[1].replace("0.0003", "0.003")]


def status(name: str, state: str = RUNNING, **more: object) -> RunStatus:
    return RunStatus(name, 1, Path("runs/quick") / name / "seed_1", state, **more)


VIEWS = [
    status(RATES[0], step=123_456, total=1_000_000, speed=1061.3, latest=4321.5),
    status(RATES[1], step=123_456, total=1_000_000, speed=61.3, latest=-321.5),
    status(RATES[2], WAITING, total=1_000_000),
    status("A3  armless_humanoid-hidden-frozen", COMPLETE, step=1_000_000, total=1_000_000, speed=80, latest=5120),
    status("A0  armless_humanoid-none-stop=threshold", step=523_456, total=1_000_000, speed=161.3, latest=99),
    status("H0  [bold]humanoid[/bold]", FAILED, reason="RuntimeError: the cart [0] has no wheels"),
]


def printed(width: int, views: list[RunStatus] = VIEWS) -> list[str]:
    console = Console(width=width, file=io.StringIO(), highlight=False)
    console.print(run_table(views, console))
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [40, 45, 60, 79, 80, 100, 120, 300])
def test_state_speed_time_left_and_return_are_whole_at_any_width(width):
    header, *lines = printed(width)
    assert len(lines) == len(VIEWS)
    assert all(len(line) <= width for line in [header, *lines])
    kept = [line.split() for line in lines]
    assert [words[-3:] for words in kept] == [
        ["1,061", "13:46", "4,322"],
        ["61", "3:58:19", "-322"],
        ["-", "-", "-"],
        ["80", "-", "5,120"],
        ["161", "<49:14", "99"],
        ["-", "-", "-"],
    ]
    for view, words in zip(VIEWS, kept, strict=True):
        assert view.state in words
    assert len({line.split()[0] for line in lines[:3]}) == 3, "three rates, three names"


@pytest.mark.parametrize("width", [20, 25, 30, 35])
def test_the_state_is_whole_where_there_is_room_for_little_else(width):
    for view, line in zip(VIEWS, printed(width)[1:], strict=True):
        assert view.state in line.split()
        assert len(line) <= width


def test_with_room_enough_names_are_whole_and_steps_are_told():
    header, *lines = printed(200)
    assert header.split() == ["run", "seed", "state", "step", "steps/s", "ETA", "return"]
    assert [line.startswith(view.name) for line, view in zip(lines, VIEWS, strict=True)] == [True] * len(VIEWS)
    assert " 123,456  12% " in lines[0]
    # Nothing pads a line that is searched or cut in a pipe.
    assert all(line == line.rstrip() for line in lines)


@pytest.mark.parametrize(("width", "count"), [(12, 3), (16, 3), (24, 3), (40, 3)])
def test_runs_over_one_setting_are_told_apart_among_others(width, count):
    others = ["armless_humanoid-hidden", "humanoid-none"]
    short = shorten([*RATES, *others], width)
    assert len(set(short)) == count + len(others)
    assert all("…" in name for name in short[:3])
    if width >= 24:
        assert ["1e-05" in short[0], "0.0003" in short[1], "0.003" in short[2]] == [True] * 3


@given(st.lists(st.text("abc-= /0", min_size=1, max_size=30), max_size=12), st.integers(4, 40))
def test_short_names_fit_and_are_the_same_for_the_same_run(names, width):
    short = shorten(names, width)
    assert all(len(name) <= width for name in short)
    assert len(set(zip(names, short, strict=True))) == len(set(names))
    if all(len(name) <= width for name in names):
        assert short == names


def test_names_that_end_differently_are_told_apart_down_to_four_characters():
    names = [f"armless_humanoid-{'x' * 30}{letter}" for letter in "abcdefg"]
    for width in range(4, 50):
        assert len(set(shorten(names, width))) == len(names)


def test_reasons_are_told_once_and_not_read_as_markup():
    alike = [status(f"run{number}", BLOCKED, reason="waits for its teacher") for number in range(3)]
    lines = [line.plain for line in reasons([*VIEWS, status("other", LOST, reason="gone"), *alike])]
    assert lines == [
        "failed  H0  [bold]humanoid[/bold] seed 1: RuntimeError: the cart [0] has no wheels",
        "lost  other seed 1: gone",
        "blocked  3 runs: waits for its teacher",
    ]


def some_runs(folder: Path) -> list[str]:
    """The command that looks at them."""
    for name in RATES[:2]:
        heartbeat(folder / "quick" / name / "seed_1", process=1, host="elsewhere")
    ended(folder / "quick" / RATES[2] / "seed_1")
    return [sys.executable, "-m", "sweeps.status", str(folder)]


def test_what_goes_through_a_pipe_is_not_cropped(tmp_path):
    told = subprocess.run(some_runs(tmp_path), capture_output=True, text=True, check=True)
    assert told.stdout.count("\n") == 5
    assert all(f"quick/{name}  " in told.stdout for name in RATES)
    assert "\x1b" not in told.stdout


def in_a_terminal(command: list[str], width: int, height: int = 24) -> tuple[subprocess.Popen[bytes], int]:
    """A program in a terminal of its own, and our end of that."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", height, width, 0, 0))
    variables = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "LINES", "NO_COLOR")}
    process = subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env={**variables, "TERM": "xterm"}, start_new_session=True
    )
    os.close(theirs)
    return process, ours


def read_until(terminal: int, end: bytes | None = None) -> bytes:
    """What a terminal shows until it shows this, or until nobody writes to it any more."""
    said = b""
    # Linux ends a terminal that nobody writes to any more with an error.
    with suppress(OSError):
        while (end is None or end not in said) and (part := os.read(terminal, 65536)):
            said += part
    return said


@pytest.mark.parametrize("width", [40, 80, 120])
def test_make_status_fits_a_real_terminal(tmp_path, width):
    process, ours = in_a_terminal(some_runs(tmp_path), width)
    said = read_until(ours)
    os.close(ours)
    assert process.wait() == 0, said
    assert b"\x1b[36m" in said, "what runs is colored"
    header, *lines, _ = Text.from_ansi(said.decode().replace("\r", "")).plain.splitlines()
    assert (header.split()[0], header.split()[-1]) == ("run", "return")
    assert [sorted({"running", "complete"} & set(line.split())) for line in lines] == [
        ["running"], ["complete"], ["running"]
    ]  # fmt: skip
    assert all(len(line) <= width for line in lines)
    assert len({line.split()[0] for line in lines}) == 3


def test_one_who_watches_sees_what_changes_until_nothing_runs(tmp_path):
    process, ours = in_a_terminal([*some_runs(tmp_path), "--watch", "0.1"], 100, height=8)
    read_until(ours, b"2 running")
    ended(tmp_path / "quick" / RATES[0] / "seed_1")
    said = read_until(ours, b"1 running")
    assert b"2 complete" in said
    ended(tmp_path / "quick" / RATES[1] / "seed_1", "diverged")
    last = Text.from_ansi(read_until(ours).decode().replace("\r", "")).plain.splitlines()
    os.close(ours)
    assert process.wait() == 0
    assert last[-1] == "3 runs: 2 complete, 1 diverged"


def test_one_who_has_seen_enough_is_left_with_the_table(tmp_path):
    process, ours = in_a_terminal([*some_runs(tmp_path), "--watch", "60"], 100)
    read_until(ours, b"2 running")
    process.send_signal(signal.SIGINT)
    said = read_until(ours)
    os.close(ours)
    assert process.wait() == 0
    assert b"3 runs: 1 complete, 2 running" in said
    assert b"Traceback" not in said


@pytest.mark.parametrize(("words", "says"), [
    (["--watch"], "--watch: needs a terminal"), (["--watch", "0"], "0: seconds from 0.1"),
    (["--watch", "soon"], "soon: seconds from 0.1 to 86,400 are needed"), (["--watch=nan"], "nan: seconds"),
])  # fmt: skip
def test_what_cannot_be_watched_is_one_line(tmp_path, words, says):
    told = subprocess.run([*some_runs(tmp_path), *words], capture_output=True, text=True, check=False)
    assert told.returncode == 2
    assert says in told.stderr.splitlines()[-1]

"""What is shown ends no command: readers that go, full disks, closed streams, terminals of other encodings."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from analysis_runs import rows_reaching, write_run
from finished_run import make_run

ROOT = Path(__file__).resolve().parents[1]
#: Its folder has a name that not every terminal can show.
FOLDER = "rüns – ☃"
#: Some seconds, most of which go by before the first step.
TRAINING = (
    "run.py env=gym env.id=Pendulum-v1 env.max_episode_steps=50 total_timesteps=1500 agent.hidden_sizes=[8] "
    "agent.batch_size=8 agent.learning_starts=50 checkpoint_every=200 tracking=tensorboard output_dir=$RUNS"
)
#: How a stream may be of no use, as typed behind a command; the exit code is the command's own.
USELESS = {
    "a reader that has seen enough": "| head -n 1; exit ${PIPESTATUS[0]}",
    "a reader that reads nothing": "| true; exit ${PIPESTATUS[0]}",
    "a full disk": ">/dev/full 2>&1",
    "closed": "<&- >&- 2>&-",
    "open to be read only": "1</dev/null 2</dev/null",
    "ascii": "PYTHONIOENCODING=ascii",
    "two bytes a letter": "PYTHONIOENCODING=utf-16",
    "latin-1, without a buffer": "PYTHONIOENCODING=latin-1 PYTHONUNBUFFERED=1",
}
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "TERM": "xterm", "COLUMNS": "150"}


def shell(command: str, useless: str, runs: Path) -> subprocess.CompletedProcess[bytes]:
    """Runs a command of the project in a shell."""
    before, behind = (useless, "") if useless.startswith("PYTHON") else ("", useless)
    line = f"{before} {sys.executable} {command} {behind}"
    return subprocess.run(
        ["bash", "-c", line], cwd=ROOT, env={**ENVIRONMENT, "RUNS": str(runs)}, capture_output=True, timeout=120
    )


def ended_well(done: subprocess.CompletedProcess[bytes], code: int = 0) -> bool:
    return done.returncode == code and b"Traceback" not in done.stderr and b"Exception ignored" not in done.stderr


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run to analyze and one to evaluate."""
    folder = tmp_path_factory.mktemp("command") / FOLDER
    write_run(folder / "quick", "A1", 1, rows_reaching(50_000, 100_000), profile="quick", total=100_000)
    make_run(folder / "evaluated" / "ant_three_legs-none" / "seed_1")
    return folder


@pytest.mark.parametrize("useless", USELESS.values(), ids=USELESS)
@pytest.mark.parametrize("command", ["-m sweeps.status $RUNS", "-m analysis $RUNS/quick --summary", "run.py sed=1"])
@pytest.mark.first_is_fast
def test_what_is_shown_ends_no_command(command: str, useless: str, runs: Path) -> None:
    done = shell(command.replace("$RUNS", '"$RUNS"'), useless, runs)
    assert ended_well(done, 2 if "run.py" in command else 0), (done.returncode, done.stderr.decode())


@pytest.mark.parametrize(
    ("command", "useless"),
    [
        ("-m acmr.envs Pendulum-v1", ">/dev/full 2>&1"),
        ("-m acmr.envs", "<&- >&- 2>&-"),
        ("-m analysis.publish $RUNS/quick $RUNS/published", ">/dev/full"),
        ("-m analysis $RUNS/quick --no-stills --format png --out $RUNS/results", "<&- >&- 2>&-"),
        ("-m acmr.evaluation $RUNS/evaluated/ant_three_legs-none/seed_1 --episodes 2", "| true; exit ${PIPESTATUS[0]}"),
        ("run.py -m profile=quick seed=1,2 plan=true output_dir=$RUNS", "PYTHONIOENCODING=ascii"),
        ("run.py --help", ">/dev/full 2>&1"),
    ],
)
@pytest.mark.first_is_fast
def test_the_other_commands_do_their_work_too(command: str, useless: str, runs: Path) -> None:
    done = shell(command.replace("$RUNS", f"'{runs}'"), useless, runs)
    assert ended_well(done), (done.returncode, done.stderr.decode())
    made = {"publish": "published", "--out": "results/table3.md", "evaluation": "evaluated/*/*/evaluation.json"}
    for word, left in made.items():
        assert word not in command or list(runs.glob(left))


#: A program of the kind that all commands are, in a moment: more lines than any buffer holds, and its end.
SHORT = """-c "
from acmr.command import command
@command
def main():
    for stream in (sys.stdout, sys.stderr):
        print('rüns ☃' * 20_000, file=stream, flush=True)
    os.write(9, b'came to its end')
    return 7
import os, sys
sys.exit(main())
" 9>$RUNS/end """


@pytest.mark.parametrize("useless", USELESS.values(), ids=USELESS)
def test_no_stream_ends_what_is_made_a_command(useless: str, tmp_path: Path) -> None:
    done = shell(SHORT, useless, tmp_path)
    assert ended_well(done, 7), (done.returncode, done.stderr[-500:])
    assert (tmp_path / "end").read_text() == "came to its end"


@pytest.mark.parametrize(
    "useless", [">/dev/full 2>&1", "<&- >&- 2>&-", "PYTHONIOENCODING=utf-16", "PYTHONIOENCODING=cp500"]
)
@pytest.mark.first_is_fast
def test_a_training_comes_to_its_end(useless: str, tmp_path: Path) -> None:
    done = shell(TRAINING.replace("$RUNS", f"'{tmp_path / FOLDER}'"), useless, tmp_path)
    assert ended_well(done), (done.returncode, done.stderr.decode())
    assert_complete(tmp_path)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
@pytest.mark.first_is_fast
def test_a_terminal_that_goes_away_or_has_another_encoding(encoding: str, tmp_path: Path) -> None:
    parent, child = pty.openpty()
    words = [*TRAINING.split()[:-1], f"output_dir={tmp_path / FOLDER}"]
    process = subprocess.Popen(
        [sys.executable, *words], cwd=ROOT, stdin=child, stdout=child, stderr=child,
        env={**ENVIRONMENT, "PYTHONIOENCODING": encoding},
    )  # fmt: skip
    os.close(child)
    shown = read(parent, until=b"no episode yet" if encoding == "latin-1" else b"complete")
    os.close(parent)
    assert process.wait(timeout=120) == 0, shown.decode(encoding)
    assert b"steps/s" in shown
    assert ("r?ns" if encoding == "ascii" else "rüns").encode(encoding) in shown
    assert_complete(tmp_path)


def read(terminal: int, until: bytes) -> bytes:
    shown = b""
    while until not in shown:
        try:
            shown += os.read(terminal, 65536)
        except OSError:  # the program has gone
            break
    return shown


def assert_complete(folder: Path) -> None:
    (run,) = folder.glob(f"{FOLDER}/paper/*/seed_1")
    for name, key in (("summary.json", "status"), ("status.json", "state")):
        assert json.loads((run / name).read_text())[key] == "complete"
    # The trackers have been closed, and everything that was said stands in the log.
    assert list(run.glob("**/events.*"))
    assert "complete" in (run / "run.log").read_text(encoding="utf-8").splitlines()[-1]


#: Prints, warns, logs, writes to the numbers of the streams as libraries in C do, and opens a file.
LIBRARIES = f"""
import logging, os, sys, warnings
sys.path.append({str(ROOT)!r})
from acmr.command import command

@command
def main():
    with open(sys.argv[1], "w", encoding="utf-8") as file:
        for number in (1, 2):
            try:
                os.write(number, b"from C")
            except OSError:
                pass
        print("☃" * 20000)
        warnings.warn("☃")
        logging.getLogger().error("☃")
        sys.stderr.write("☃")
        sys.stdout.flush()
        file.write("the file's own")
    return 7

sys.exit(main())
"""


@pytest.mark.parametrize("useless", USELESS.values(), ids=USELESS)
def test_what_libraries_print_is_lost_and_lands_in_no_file(useless: str, tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(textwrap.dedent(LIBRARIES), encoding="utf-8")
    done = shell(f"{tmp_path / 'program.py'} {tmp_path / 'file'}", useless, tmp_path)
    assert ended_well(done, 7), (done.returncode, done.stderr.decode())
    assert (tmp_path / "file").read_text(encoding="utf-8") == "the file's own"


def test_what_can_be_shown_is_shown_whole(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(textwrap.dedent(LIBRARIES), encoding="utf-8")
    done = shell(f"{tmp_path / 'program.py'} {tmp_path / 'file'}", "| cat; exit ${PIPESTATUS[0]}", tmp_path)
    assert done.stdout.decode() == "from C" + "☃" * 20000 + "\n"
    assert "UserWarning: ☃" in done.stderr.decode()
    assert done.stderr.decode().endswith("☃\n☃")


LONG = "n" * 300


@pytest.mark.parametrize(
    "command",
    [
        f"-m sweeps.status {LONG}",
        f"-m acmr.tracking.mirror dashboard {LONG}",
        f"-m acmr.tracking.mirror sync --base-url http://127.0.0.1:9 {LONG}",
        f"-m acmr.transfer.half $RUNS/evaluated/ant_three_legs-none/seed_1 {LONG}",
        f"-m acmr.evaluation {LONG}",
        f"-m analysis {LONG}",
        f"run.py +env.kwargs.{LONG}=1",
        f"run.py --config-name={LONG}",
        f"run.py --config-dir={LONG}",
        f"run.py hydra.searchpath=[{LONG}]",
        f"run.py matrix={LONG}",
    ],
    ids=lambda command: command.replace(LONG, "300"),
)
def test_a_name_that_no_file_has_is_one_line(command: str, runs: Path) -> None:
    done = shell(command.replace("$RUNS", f"'{runs}'"), "", runs)
    assert done.returncode == 2
    (line,) = done.stderr.decode().splitlines()
    assert LONG in line
    assert "File name too long" in line


@pytest.mark.parametrize("command", ["-m sweeps.status", "-m acmr.envs", "-m acmr.evaluation runs", "{run}"])
def test_a_current_folder_that_is_gone_is_one_line(command: str, tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    line = f"cd {gone} && rmdir {gone} && {sys.executable} {command.format(run=ROOT / 'run.py')}"
    variables = {**ENVIRONMENT, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", line], env=variables, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "error: the current folder is gone (No such file or directory); cd to one that is there"
    ]

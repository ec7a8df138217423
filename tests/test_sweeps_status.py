"""What ``make status`` says of runs that wait, learn, ended, failed and vanished."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest

from acmr.records import FAILED, RUNNING, STOPPED
from sweeps.folder import SweepFolder, all_folders
from sweeps.screen.table import counts
from sweeps.state import State, SweepRun
from sweeps.status import main
from sweeps.view import view_entries, view_run

CONF = Path(__file__).resolve().parent.parent / "conf"


def entry(index: int, **more: object) -> SweepRun:
    values = {"index": index, "name": f"run{index}", "cell": None, "seed": index, "total_timesteps": 1000, "threads": 1}
    values |= {"directory": f"quick/run{index}/seed_{index}", "teacher": None, "ended": None}
    return SweepRun(**(values | more))


def heartbeat(
    folder: Path, state: str = "running", process: int | None = None, age: float = 0.0, **more: object
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    told = {
        "state": state,
        "global_step": 250,
        "total_timesteps": 1000,
        "steps_per_second": 50.0,
        "latest_return": 12.5,
    }
    told |= {"process": process or os.getpid(), "host": os.uname().nodename, "updated": time.time() - age}
    (folder / "status.json").write_text(json.dumps(told | more))


def ended(folder: Path, status: str = "complete") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    summary = {"status": status, "global_step": 1000, "total_timesteps": 1000, "steps_per_second": 80.0}
    (folder / "summary.json").write_text(json.dumps(summary | {"final_return": 99.0}))
    (folder / "config.yaml").write_text("seed: 1\n")


def gone() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def sweep(out: Path, *entries: SweepRun) -> SweepFolder:
    header = {"command": "python run.py", "retries": 2, "grace": 20}
    return SweepFolder.create(out, header, entries, [entry.index for entry in entries], CONF)


@pytest.mark.parametrize(
    ("make", "state"),
    [
        (lambda folder: None, "stopped"),
        (heartbeat, "running"),
        (lambda folder: heartbeat(folder, "stopped"), "stopped"),
        (lambda folder: heartbeat(folder, "failed", cause="KeyError: 'x'"), "failed"),
        (lambda folder: heartbeat(folder, process=gone()), "lost"),
        (lambda folder: heartbeat(folder, age=3600), "lost"),
        (lambda folder: heartbeat(folder, host="elsewhere", process=1), "running"),
        (lambda folder: heartbeat(folder, host="elsewhere", age=3600), "lost"),
        (ended, "complete"),
        (lambda folder: ended(folder, "diverged"), "diverged"),
    ],
)
def test_a_run_is_what_its_files_say(tmp_path, make, state):
    make(tmp_path / "seed_1")
    assert view_run(tmp_path / "seed_1", "run", 1).state == state


@pytest.mark.parametrize(
    ("known", "state"),
    [
        (State(RUNNING), "running"),
        (State(FAILED, 3, "no"), "failed"),
        (State(STOPPED), "stopped"),
        (State(), "waiting"),
    ],
)
def test_a_run_of_a_sweep_is_what_the_sweep_says(tmp_path, known, state):
    assert view_run(tmp_path / "seed_1", "run", 1, 1000, known).state == state


def test_speed_and_time_left(tmp_path):
    heartbeat(tmp_path)
    view = view_run(tmp_path, "run", 1)
    assert (view.step, view.total, view.speed, view.latest) == (250, 1000, 50.0, 12.5)
    assert view.seconds_left == pytest.approx(15)


def test_students_of_a_failed_teacher_are_blocked_and_the_others_wait(tmp_path):
    entries = [entry(0), entry(1), entry(2, teacher=0), entry(3, teacher=1)]
    states = [State(FAILED, 3, "boom"), State(RUNNING), State(), State()]
    views = view_entries(tmp_path, entries, states)
    assert [view.state for view in views] == ["failed", "running", "blocked", "waiting"]
    assert views[2].reason == "waits for its teacher run0 seed 0, which failed"
    assert counts(views) == "1 running, 1 waiting, 1 blocked, 1 failed"


def test_the_exit_code_says_whether_a_run_failed(tmp_path, capsys):
    assert main([str(tmp_path / "nothing")]) == 0
    folder = sweep(tmp_path, entry(1), entry(2), entry(3))
    ended(tmp_path / "quick/run1/seed_1")
    heartbeat(tmp_path / "quick/run2/seed_2")
    folder.set_state(2, State(RUNNING))
    assert main([str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "3 runs: 1 complete, 1 running, 1 waiting; 50 steps/s, 35 s left" in text
    assert any(line.split()[:6] == ["quick/run2", "2", "running", "250", "25%", "50"] for line in text.splitlines())
    folder.set_state(3, State(FAILED, 3, "RuntimeError: no wheels"))
    assert main([str(tmp_path)]) == 1
    assert "RuntimeError: no wheels" in capsys.readouterr().out
    # It was repaired meanwhile.
    ended(tmp_path / "quick/run3/seed_3")
    assert main([str(tmp_path)]) == 0


def test_folders_of_old_sweeps_go_and_those_of_live_ones_stay(tmp_path):
    alive = sweep(tmp_path, entry(0))
    for number in range(13):
        folder = sweep(tmp_path, entry(number))
        folder.release()
        folder.path.rename(folder.path.with_name(f"{number:02}"))
    assert 10 <= len(all_folders(tmp_path)) <= 12
    assert alive.path.exists()
    assert [folder.is_alive() for folder in all_folders(tmp_path)] == [True] + [False] * (
        len(all_folders(tmp_path)) - 1
    )


def test_one_claim_at_a_time_and_none_outlives_its_process(tmp_path):
    folder = sweep(tmp_path, entry(0))
    code = f"from sweeps.folder import *; import time\nwith SweepFolder(Path({str(folder.path)!r})).claim(0) as mine:\n"
    code += " print(mine, flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "True\n"
        with folder.claim(0) as mine:
            assert not mine
        other.kill()
        other.wait()
    with folder.claim(0) as mine:
        assert mine


def test_a_thousand_runs_take_less_than_two_seconds_of_cpu(tmp_path):
    entries = [entry(index) for index in range(1000)]
    folder = sweep(tmp_path, *entries)
    for index in range(0, 1000, 2):
        ended(tmp_path / entries[index].directory)
        heartbeat(tmp_path / entries[index + 1].directory)
        folder.set_state(index + 1, State(RUNNING))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    told = subprocess.run([sys.executable, "-m", "sweeps.status", str(tmp_path)], capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 2
    assert told.returncode == 0, told.stderr
    assert "1000 runs: 500 complete, 500 running" in told.stdout

"""Sweeps as users start them: real processes, real kills, and what is there afterwards."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TINY = ("profile=quick", "tracking=off", "progress=off", "total_timesteps=300")
#: Long enough to be found and killed in the middle: a run says every two seconds where it is, and a fast core takes
#: 1,500 steps a second.
SHORT = ("profile=quick", "tracking=off", "progress=off", "total_timesteps=8000")
FOUR = ("experiment=H0,A1", "seed=1,2")
BROKEN_ENVIRONMENTS = """
import os
import signal
import gymnasium as gym
import numpy as np


class Cart(gym.Env):
    observation_space = gym.spaces.Box(-10, 10, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, end="none"):
        self.end, self.steps = end, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 250:
            if self.end == "raise":
                raise RuntimeError("the cart has no wheels")
            if self.end == "exit":
                os._exit(9)
            if self.end == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
        return np.zeros(2, np.float32), 1.0, False, False, {}


for end in ("none", "raise", "exit", "kill"):
    gym.register(f"{end.title()}-v0", Cart, max_episode_steps=50, kwargs={"end": end})
"""


def command(out: Path, *words: str, root: Path = ROOT) -> list[str]:
    return [sys.executable, str(root / "run.py"), *words, f"output_dir={out}"]


def variables(**more: str) -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", **more}


def run(out: Path, *words: str, **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(out, *words), env=variables(**more), cwd=out.parent, capture_output=True, text=True, timeout=280
    )


def start(out: Path, *words: str, root: Path = ROOT) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command(out, *words, root=root),
        env=variables(),
        cwd=out.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=heed,
    )


def heed() -> None:
    """A test runner in the background may ignore these signals, and so would what it starts."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def trainings(out: Path) -> dict[int, int]:
    """Trainings of the sweeps in a folder, each with its parent."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, IndexError):
            continue
        if any(word.startswith(f"@{out}/".encode()) for word in words):
            found[int(folder.name)] = parent
    return found


def await_that(condition: Callable[[], object], seconds: float = 90) -> object:
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.1)
    return value


def await_learning(out: Path, sweep: subprocess.Popen[str], count: int = 2) -> None:
    """Waits until so many trainings have taken steps."""

    def learning() -> bool:
        assert sweep.poll() is None, sweep.communicate()[0]
        told = [json.loads(path.read_text()) for path in out.glob("*/*/*/status.json")]
        return sum(status["state"] == "running" and status["global_step"] > 0 for status in told) >= count

    await_that(learning)


def complete(out: Path) -> list[Path]:
    found = [path for path in sorted(out.glob("*/*/*/summary.json")) if json.loads(path.read_text())["status"]]
    assert all(json.loads(path.read_text())["status"] == "complete" for path in found)
    return found


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.mark.slow
def test_students_bring_their_teacher_and_a_second_time_nothing_is_left_to_do(out):
    words = ["-m", "transfer=hidden,expand", "agent.hidden_sizes=[16,16]", *TINY]
    first = run(out, *words)
    assert first.returncode == 0, first.stdout + first.stderr
    assert "3 of 3 runs complete" in first.stdout
    assert len(complete(out)) == 3
    teacher = next(out.glob("quick/ant-none*/seed_1"))
    student = json.loads(next(out.glob("quick/*expand*/seed_1/transfer.json")).read_text())
    assert Path(student["teacher"]["path"]).parent == teacher
    assert "complete" in (teacher / "output.log").read_text()
    stamps = {path: path.stat().st_mtime_ns for path in complete(out)}
    again = run(out, *words)
    assert (again.returncode, again.stdout.count("\n")) == (0, 1)
    assert "2 of 2 runs complete" in again.stdout
    assert stamps == {path: path.stat().st_mtime_ns for path in complete(out)}


def test_a_plan_starts_nothing(out):
    told = run(out, "matrix=paper", "plan=true", "seed=1,2,3,4,5", "experiment=H0,A0,A2")
    assert told.returncode == 0, told.stderr
    assert "15 runs: 0 done, 15 missing (10, then 5)" in told.stdout
    for word in ("time: not known", "memory: ", "disk: "):
        assert word in told.stdout
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["-m", "transfer=hiden,expand"], "did you mean transfer=hidden?"),
        (["matrix=papr"], "matrix=papr: must be one of demo, paper, quick, shifts"),
        (["matrix=quick", "experiment=H0,B7"], "experiment=B7: must be one of A0"),
        (["matrix=quick", "retries=some"], "retries=some: an integer"),
        (["matrix=quick", "workers=0"], "workers=0: an integer"),
    ],
)
@pytest.mark.first_is_fast
def test_a_wrong_word_is_refused_in_one_line_before_anything_starts(out, words, says):
    told = run(out, *words)
    assert told.returncode == 2
    assert told.stderr.startswith("error: ")
    assert told.stderr.count("\n") == 1
    assert says in told.stderr
    assert not out.exists()


@pytest.mark.parametrize("retries", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_run_that_raises_exits_or_is_killed_takes_no_other_with_it(out, tmp_path, retries):
    (tmp_path / "broken.py").write_text(BROKEN_ENVIRONMENTS)
    ids = ",".join(f"broken:{name}-v0" for name in ("Raise", "Exit", "Kill", "None"))
    small = ["total_timesteps=400", "agent.learning_starts=300", "agent.hidden_sizes=[8,8]", "tracking=off"]
    told = run(out, "-m", "env=gym", f"env.id={ids}", *small, f"retries={retries}", PYTHONPATH=str(tmp_path))
    assert told.returncode == 1, told.stdout + told.stderr
    assert "1 of 4 runs complete" in told.stdout
    assert [path.parent.parent.name for path in complete(out)] == [
        "broken_None-v0-none-hidden_sizes=8+8-learning_starts=300-total_timesteps=400"
    ]
    ends = re.findall(r"^failed  (\S+) seed 1: (.+)\n  log: (\S+/output\.log)$", told.stdout, re.MULTILINE)
    assert len(ends) == 3, told.stdout
    where = r"^failed .*failed at step 250: .*RuntimeError: .* \(broken.py:23, in step\)"
    assert re.search(where, told.stdout, re.MULTILINE), told.stdout
    for reason in ("RuntimeError: the cart has no wheels", "exit code 9", "killed by SIGKILL"):
        (log,) = (log for name, why, log in ends if reason in why and name in log)
        assert Path(log).read_text().count("Traceback") == (retries + 1 if reason.startswith("RuntimeError") else 0)
    states = [json.loads(path.read_text()) for path in sorted(out.glob(".sweeps/*/states/*"))]
    assert sorted(state["failures"] for state in states) == [0] + [retries + 1] * 3


@pytest.mark.slow
def test_a_second_sweep_on_the_same_runs_is_refused(out):
    sweep = start(out, "-m", "seed=1,2", *TINY)
    try:
        await_that(lambda: list(out.glob(".sweeps/*/plan.json")))
        told = run(out, "-m", "seed=2,3", *TINY)
        assert told.returncode == 2
        assert f"process {sweep.pid} has it in its sweep" in told.stderr
        assert told.stderr.count("\n") == 1
    finally:
        sweep.terminate()
        sweep.communicate(timeout=60)


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["training", "worker"])
def test_a_killed_training_or_worker_costs_no_run(out, victim):
    sweep = start(out, "-m", *FOUR, *SHORT)
    await_learning(out, sweep)
    process, worker = next(iter(trainings(out).items()))
    os.kill(process if victim == "training" else worker, signal.SIGKILL)
    # Four runs of SHORT on a machine whose cores others use, too.
    text = sweep.communicate(timeout=500)[0]
    assert sweep.returncode == 0, text
    assert "4 of 4 runs complete" in text
    assert len(complete(out)) == 4
    assert not trainings(out)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGKILL, -9)]
)
def test_a_stopped_sweep_leaves_no_process_and_the_same_command_ends_it(out, number, code):
    words = ["-m", *FOUR, *SHORT]
    sweep = start(out, *words)
    await_learning(out, sweep)
    sweep.send_signal(number)
    began = time.monotonic()
    text = sweep.communicate(timeout=60)[0]
    await_that(lambda: not trainings(out), 30)
    assert time.monotonic() - began < 20
    assert sweep.returncode == code, text
    if number != signal.SIGKILL:
        assert "to go on: python" in text
        assert "-m experiment=H0,A1 seed=1,2 profile=quick" in text
    under_way = [path for path in out.glob("*/*/*/status.json") if json.loads(path.read_text())["state"] == "stopped"]
    assert len(under_way) == 2
    again = run(out, *words)
    assert again.returncode == 0, again.stdout + again.stderr
    assert len(complete(out)) == 4
    # Ctrl-C, SIGTERM and the parent's death alike gave them time for a checkpoint.
    assert all("resumed at step" in (path.parent / "run.log").read_text() for path in under_way)


@pytest.mark.slow
def test_what_is_edited_in_mid_sweep_changes_nothing(out, tmp_path):
    root = tmp_path / "copy"
    for name in ("acmr", "sweeps", "hydra_plugins", "conf"):
        shutil.copytree(ROOT / name, root / name)
    shutil.copy(ROOT / "run.py", root)
    sweep = start(out, "-m", *FOUR, *TINY, "agent.hidden_sizes=[16,16]", root=root)
    await_that(lambda: trainings(out))
    (root / "conf" / "profile" / "quick.yaml").write_text("profile: [broken")
    (root / "conf" / "transfer" / "hidden.yaml").unlink()
    text = sweep.communicate(timeout=170)[0]
    assert sweep.returncode == 0, text
    assert len(complete(out)) == 4


@pytest.mark.slow
def test_a_matrix_survives_kills_of_a_training_a_worker_and_its_parent(out):
    words = ["matrix=quick", *TINY[1:]]
    sweep = start(out, *words)
    for target in ("training", "worker"):
        before = len(complete(out))
        await_that(lambda before=before: len(complete(out)) > before and trainings(out))
        process, worker = next(iter(trainings(out).items()))
        os.kill(process if target == "training" else worker, signal.SIGKILL)
    before = len(complete(out))
    await_that(lambda: len(complete(out)) > before and trainings(out))
    sweep.kill()
    sweep.communicate()
    assert len(complete(out)) < 21
    again = run(out, *words)
    assert again.returncode == 0, again.stdout + again.stderr
    assert "21 of 21 runs complete" in again.stdout
    runs = complete(out)
    assert len(runs) == 21
    for path in runs:
        steps = [int(line.split(",")[0]) for line in (path.parent / "episodes.csv").read_text().splitlines()[1:]]
        assert steps == sorted(set(steps))

"""Signals, full disks, numbers that are no longer finite, a second process: each has an end that says what to do."""

import errno
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from torture import ANT, SMALL, Run, at_step, at_write, count_writes, fail_with, same

from acmr.envs.physics import PhysicsWarnings

ROOT = Path(__file__).resolve().parent.parent
#: As few durable writes as show every kind of them: two checkpoints, episodes, metrics, the end.
SHORT = (
    *(word for word in ANT if not word.startswith(("total_timesteps", "env.max_episode_steps", "agent.learning"))),
    "total_timesteps=90", "env.max_episode_steps=25", "agent.learning_starts=50",
)  # fmt: skip


@pytest.fixture(scope="module")
def untouched(tmp_path_factory):
    """What undisturbed runs leave."""
    made = {}

    def of(overrides: tuple[str, ...]) -> dict[str, bytes]:
        if overrides not in made:
            made[overrides] = Run(tmp_path_factory.mktemp("untouched"), overrides).finish()
        return dict(made[overrides])

    return of


def error_of(said: str) -> str:
    (line,) = [line for line in said.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in said
    return line


@pytest.mark.parametrize(
    ("number", "name", "code"),
    [(signal.SIGTERM, "SIGTERM", 143), (signal.SIGINT, "Ctrl-C", 130), (signal.SIGHUP, "SIGHUP", 129)],
)
def test_a_signal_stops_at_the_end_of_the_step(number, name, code, untouched, tmp_path):
    run = Run(tmp_path, ANT)
    ended = run(at_step(123, lambda: os.kill(os.getpid(), number)))
    assert ended.code == code
    assert f"stopped by {name} at step 123; run the same command to resume: it resumes at step 123" in ended.said
    assert run.checkpoints == [120, 123]
    assert json.loads((run.folder / "status.json").read_text())["state"] == "stopped"
    assert run(at_step(130)).said.count("resumed at step 123 of 300") == 1
    same(run.finish(), untouched(ANT))


def test_a_signal_waits_for_the_end_of_the_episode_where_that_is_needed(tmp_path):
    overrides = ("env=gym", "env.id=Pendulum-v1", "env.max_episode_steps=30", "total_timesteps=100", *SMALL)
    run = Run(tmp_path, overrides)
    ended = run(at_step(35, lambda: os.kill(os.getpid(), signal.SIGTERM)))
    assert ended.code == 143
    assert "stopped by SIGTERM at step 60" in ended.said


def test_ctrl_c_in_a_terminal_reaches_the_whole_group(tmp_path):
    words = [word for word in ANT if not word.startswith(("total", "tracking"))]
    command = [sys.executable, str(ROOT / "run.py"), f"output_dir={tmp_path}", "total_timesteps=100000", *words]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    wait_for(lambda: list(tmp_path.glob("paper/*/seed_1/checkpoint/step_*.json")))
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, out + err
    assert re.search(r"stopped by Ctrl-C at step ([\d,]+); run the same command to resume", out)
    assert err == ""


def wait_for(condition, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_one_process_a_run(tmp_path, untouched):
    run = Run(tmp_path, ANT)
    first = run.start(at_step(100, lambda: time.sleep(3)))
    wait_for(lambda: run.checkpoints)
    others = [run.start() for _ in range(3)]
    for other in others:
        ended = run.wait(other)
        assert ended.code == 75
        assert re.search(rf"error: \S+seed_1: held by process {first} on \S+ since \d{{4}}-", ended.said)
    assert run.wait(first).code == 0
    same(run.outcome(), untouched(ANT))


def test_the_lock_dies_with_its_holder(tmp_path):
    run = Run(tmp_path, ANT)
    child = run.start(at_step(60, lambda: time.sleep(600)))
    wait_for(lambda: run.checkpoints)
    os.kill(child, signal.SIGKILL)
    run.wait(child)
    assert run().code == 0


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_a_disk_that_takes_no_checkpoint(code, tmp_path, untouched):
    run = Run(tmp_path, ANT)
    count = tmp_path / "writes"
    assert run(count_writes(count)).code == 0
    names = count.read_text().splitlines()
    shutil.rmtree(run.folder)
    number = names.index("write step_120.json") + 1
    ended = run(at_write(number, fail_with(code)))
    assert ended.code == 74
    remedy = {errno.ENOSPC: "free some space there", errno.EIO: "see to that disk", errno.EDQUOT: "free some of your"}
    line = error_of(ended.said)
    assert f"step_120.json ({os.strerror(code)}); {remedy[code]}" in line
    assert line.endswith("then run the same command again; it resumes at step 80")
    assert run.checkpoints[-1] == 80
    same(run.finish(), untouched(ANT))


@pytest.mark.slow
@pytest.mark.parametrize(("code", "stride"), [(errno.ENOSPC, 1), (errno.EIO, 3)])
def test_each_durable_write_may_fail(code, stride, tmp_path, untouched):
    run = Run(tmp_path, SHORT)
    count = tmp_path / "writes"
    run(count_writes(count))
    names = count.read_text().splitlines()
    assert len(names) > 60
    for number in range(1, len(names) + 1, stride):
        shutil.rmtree(run.folder)
        ended = run(at_write(number, fail_with(code)))
        complete = (run.folder / "summary.json").exists()
        # Once the summary is there only leftovers remain to be removed, which the next start does.
        assert ended.code == 74 or (complete and ended.code == 0), (names[number - 1], ended.said)
        if ended.code:
            assert os.strerror(code) in error_of(ended.said)
        same(run.finish() if not complete else finished_before(run), untouched(SHORT))


def finished_before(run: Run) -> dict[str, bytes]:
    ended = run()
    assert (ended.code, "complete already" in ended.said) == (0, True)
    return run.outcome()


def test_a_limit_on_the_size_of_files(tmp_path, untouched):
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))

    run = Run(tmp_path, ANT)
    ended = run(limit)
    assert ended.code == 74
    assert "File too large); raise the limit on the size of files (ulimit -f)" in error_of(ended.said)
    same(run.finish(), untouched(ANT))


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 4 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("there is no mount here")
    if done.returncode:
        pytest.skip(f"file systems cannot be mounted here: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_run_that_its_disk_cannot_take_does_not_start(small_disk):
    words = [word for word in ANT if not word.startswith(("total_", "agent.buffer"))]
    run = Run(small_disk / "runs", (*words, "total_timesteps=50000", "agent.buffer_size=50000"))
    ended = run()
    assert ended.code == 2
    assert re.search(r"takes up to 8\.\d MB while it runs, but its disk has [34]\.\d MB free; free some", ended.said)
    assert not run.folder.exists()


def test_a_disk_that_fills_up_and_is_freed(small_disk, untouched):
    run = Run(small_disk / "runs", ANT)
    filler = small_disk / "filler"

    def fill() -> None:
        with suppress(OSError), filler.open("wb", buffering=0) as stream:
            while True:
                stream.write(bytes(1 << 12))

    ended = run(at_step(110, fill))
    assert ended.code == 74, ended.said
    assert "No space left on device); free some space there" in error_of(ended.said)
    assert "it resumes at step 80" in ended.said
    ended = run()
    assert ended.code in (2, 74)  # still full: found before the start, or at the first write
    filler.unlink()
    same(run.finish(), untouched(ANT))


def test_a_disk_that_may_only_be_read(small_disk, untouched):
    run = Run(small_disk / "runs", ANT)

    def remount(mode: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{mode}", str(small_disk)], check=True)

    assert run(at_step(150)).code == -signal.SIGKILL
    remount("ro")
    try:
        made = Run(small_disk.parent / "elsewhere", ANT)
        made.output.mkdir()
        done = subprocess.run(
            [sys.executable, str(ROOT / "run.py"), f"output_dir={run.output}", *ANT], capture_output=True, text=True
        )
        assert done.returncode == 2
        assert "cannot be written (Read-only file system)" in done.stderr
    finally:
        remount("rw")
    same(run.finish(), untouched(ANT))


@pytest.mark.parametrize("kill", [None, 100])
def test_numbers_that_explode_end_the_run(kill, tmp_path):
    overrides = (*ANT, "agent.q_lr=1e30", "agent.policy_lr=1e30")
    run = Run(tmp_path, overrides)
    if kill:
        run(at_step(70))
    ended = run()
    assert ended.code == 3, ended.said
    summary = json.loads((run.folder / "summary.json").read_text())
    assert summary["status"] == "diverged"
    assert 70 < summary["step"] == summary["global_step"] < 80
    assert summary["cause"] == "the policy's action is not finite"
    assert "diverged at step" in ended.said
    assert "the checkpoint of step 40 is kept" in ended.said
    assert run.checkpoints == [40]
    assert not (run.folder / "teacher.safetensors").exists()
    again = run()
    assert again.code == 3
    assert f"diverged at step {summary['step']} ({summary['cause']}); force=true runs it anew" in again.said


class Poisoned(PendulumEnv):
    """Gives something that is not finite in its hundredth step."""

    def __init__(self, what: str, **kwargs) -> None:
        super().__init__(**kwargs)
        self.what, self.steps = what, 0

    def step(self, action):
        self.steps += 1
        observation, reward, *rest = super().step(action)
        if self.steps == 100 and self.what == "observation":
            observation = observation * np.float32(np.nan)
        if self.steps == 100 and self.what == "reward":
            reward = -np.inf
        return observation, reward, *rest


gym.register("AcmrPoisoned-v0", Poisoned, max_episode_steps=30)


@pytest.mark.parametrize(("what", "cause"), [("observation", "an observation"), ("reward", "a reward")])
def test_what_the_environment_gives_must_be_finite(what, cause, tmp_path):
    overrides = ("env=gym", "env.id=AcmrPoisoned-v0", f"+env.kwargs.what={what}", "total_timesteps=300", *SMALL)
    run = Run(tmp_path, overrides)
    ended = run()
    assert ended.code == 3, ended.said
    summary = json.loads((run.folder / "summary.json").read_text())
    assert (summary["step"], summary["cause"]) == (100, f"{cause} is not finite")


def test_a_learner_that_is_not_finite_is_never_stored(tmp_path):
    from acmr.sac import SAC

    def poison() -> None:
        update = SAC.update

        def poisoned(agent: SAC, batch: object, global_step: int) -> None:
            update(agent, batch, global_step)
            if global_step == 119:
                agent._target_parameters.values[0] = float("inf")

        SAC.update = poisoned

    run = Run(tmp_path, (*ANT, "agent.policy_frequency=1000"))
    ended = run(poison)
    assert ended.code == 3
    # The row of metrics at step 140 is the first to look at the targets; the checkpoint of step 120 was not made.
    summary = json.loads((run.folder / "summary.json").read_text())
    assert (summary["step"], run.checkpoints) == (140, [40, 80])


def test_warnings_of_the_simulation_are_counted_across_kills(tmp_path):
    def disturb() -> None:
        step = PhysicsWarnings.step
        count = 0

        def disturbed(env: PhysicsWarnings, action: object) -> object:
            nonlocal count
            count += 1
            if count == 50:
                env.unwrapped.data.qvel[0] = np.nan
            return step(env, action)

        PhysicsWarnings.step = disturbed

    run = Run(tmp_path, ANT)

    def disturb_and_die() -> None:
        disturb()
        at_step(150)()

    run(disturb_and_die)
    assert run(disturb).code == 0
    summary = json.loads((run.folder / "summary.json").read_text())
    assert summary["physics_warnings"] == {"badqvel": 2}
    assert not list(Path.cwd().glob("MUJOCO_LOG.TXT"))

"""Kills at random moments, at each durable write, and again in the recovery. ``ACMR_TORTURE=n``: n times as many."""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from torture import ANT, HUMANOID, SMALL, Run, at_step, at_write, count_writes, same

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
ROUNDS = int(os.environ.get("ACMR_TORTURE", "1"))
KINDS = {"humanoid": HUMANOID, "ant": ANT}
#: As few durable writes as show every kind of them.
SHORT = (
    *(word for word in ANT if not word.startswith(("total_timesteps", "env.max_episode_steps", "agent.learning"))),
    "total_timesteps=90", "env.max_episode_steps=25", "agent.learning_starts=50",
)  # fmt: skip


@pytest.fixture(scope="module")
def untouched(tmp_path_factory):
    """What undisturbed runs leave, and the seconds that they take."""
    made = {}

    def of(overrides: tuple[str, ...]) -> tuple[dict[str, bytes], float]:
        if overrides not in made:
            began = time.monotonic()
            outcome = Run(tmp_path_factory.mktemp("untouched"), overrides).finish()
            made[overrides] = outcome, time.monotonic() - began
        return made[overrides]

    return of


def kill_after(run: Run, seconds: float, number: int = signal.SIGKILL) -> int:
    child = run.start()
    time.sleep(seconds)
    os.kill(child, number)
    return run.wait(child).code


@pytest.mark.parametrize(("kind", "kills"), [("humanoid", 25), ("ant", 25)])
def test_random_kills(kind, kills, untouched, tmp_path):
    wanted, seconds = untouched(KINDS[kind])
    rng, killed, runs, within = random.Random(kind), 0, 0, 0
    while killed < kills * ROUNDS:
        run = Run(tmp_path / str(runs), KINDS[kind])
        for _ in range(rng.randint(1, 4)):
            code = kill_after(run, rng.uniform(0.0, seconds))
            assert code in (0, -signal.SIGKILL)
            killed += code == -signal.SIGKILL
            within += code == -signal.SIGKILL and bool(run.checkpoints)
        same(run.finish(), wanted)
        shutil.rmtree(run.output)
        runs += 1
    # Some of them must have hit a run that had something to lose.
    assert within > kills * ROUNDS / 4


@pytest.mark.parametrize("kind", KINDS)
def test_random_signals(kind, untouched, tmp_path):
    wanted, seconds = untouched(KINDS[kind])
    rng, run, stopped = random.Random(kind), Run(tmp_path, KINDS[kind]), 0
    while stopped < 10 * ROUNDS:
        number = rng.choice((signal.SIGTERM, signal.SIGINT))
        code = kill_after(run, rng.uniform(0.0, seconds), number)
        # Before the run is taken up a signal ends the process as it ends any other.
        assert code in (0, 128 + number, -number, 70), code
        stopped += code == 128 + number
        if code == 0:
            same(run.outcome(), wanted)
            shutil.rmtree(run.folder)
    same(run.finish(), wanted)


def test_a_kill_at_each_durable_write_and_again_in_the_recovery(untouched, tmp_path):
    count, run, rng = tmp_path / "writes", Run(tmp_path / "run", SHORT), random.Random(0)
    assert run(count_writes(count)).code == 0
    names = count.read_text().splitlines()
    assert {"rename step_40.json", "remove segment_0_40.safetensors", "rename summary.json"} <= set(names)
    for number in range(1, len(names) + 1):
        shutil.rmtree(run.folder)
        assert run(at_write(number)).code == -signal.SIGKILL
        for _ in range(ROUNDS):
            again = rng.randint(1, len(names))
            assert run(at_write(again)).code in (0, -signal.SIGKILL), (names[number - 1], names[again - 1])
        same(run.finish(), untouched(SHORT)[0])


def test_a_kill_at_each_durable_write_of_a_recovery(untouched, tmp_path):
    stopped, work = Run(tmp_path / "stopped", SHORT), Run(tmp_path / "work", SHORT)
    assert stopped(at_step(85)).code == -signal.SIGKILL
    count = tmp_path / "writes"
    shutil.copytree(stopped.output, work.output)
    assert work(count_writes(count)).code == 0
    for number in range(1, len(count.read_text().splitlines()) + 1):
        shutil.rmtree(work.output)
        shutil.copytree(stopped.output, work.output)
        assert work(at_write(number)).code == -signal.SIGKILL
        # The settings say where the run was first put.
        same(work.finish() | {"config.yaml": b""}, untouched(SHORT)[0] | {"config.yaml": b""})


def test_around_step_1000_of_an_episode(untouched, tmp_path):
    overrides = (
        "env=gym", "env.id=HalfCheetah-v5", "total_timesteps=1100", *SMALL,
        "agent.learning_starts=960", "agent.buffer_size=1000", "checkpoint_every=1",
    )  # fmt: skip
    undisturbed = (*overrides[:-1], "checkpoint_every=500")
    run = Run(tmp_path, overrides)
    for step in (998, 999, 1000, 1001, 1002):
        assert run(at_step(step)).code == -signal.SIGKILL
        assert run.checkpoints[-1] == step - 1
    outcome, wanted = run.finish(), dict(untouched(undisturbed)[0])
    for name in ("config.yaml", "teacher.json"):
        outcome.pop(name)
        wanted.pop(name)
    same(outcome, wanted)
    assert b"\n1000," in outcome["episodes.csv"]


def test_twenty_starts_at_once(untouched, tmp_path):
    for overrides in (ANT, HUMANOID):
        run = Run(tmp_path / overrides[0][4:], overrides)
        ready = tmp_path / "ready"
        ready.unlink(missing_ok=True)

        def await_the_others(ready: Path = ready) -> None:
            while not ready.exists():
                time.sleep(0.001)

        children = [run.start(await_the_others) for _ in range(20)]
        ready.touch()
        ends = [run.wait(child) for child in children]
        trained = [end for end in ends if "steps per second" in end.said]
        held = [end for end in ends if end.code == 75]
        late = [end for end in ends if end.code == 0 and "complete already" in end.said]
        assert len(trained) == 1
        assert len(trained) + len(held) + len(late) == 20, [end.said for end in ends]
        assert len(held) > 10
        winner = children[ends.index(trained[0])]
        for end in held:
            assert re.search(rf"held by process {winner} on \S+ since \d{{4}}-\d\d-\d\d", end.said), end.said
        same(run.outcome(), untouched(overrides)[0])


MATRIX = (
    "matrix=quick", "tracking=off", "progress=off", "total_timesteps=900", "agent.hidden_sizes=[16,16]",
    "agent.batch_size=32", "agent.learning_starts=200", "checkpoint_every=100",
)  # fmt: skip


def test_a_matrix_whose_trainings_and_then_whose_parent_are_killed(tmp_path):
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    assert sweep(undisturbed).wait(600) == 0
    rng, parent = random.Random(0), sweep(disturbed)
    for _ in range(5):
        victim = None
        while victim is None:
            assert parent.poll() is None
            time.sleep(rng.uniform(0.2, 0.6))
            victim = next(iter(rng.sample(found := learning(disturbed), len(found))), None)
        os.kill(victim, signal.SIGKILL)
    time.sleep(rng.uniform(0.5, 3.0))
    parent.kill()
    parent.wait()
    assert sweep(disturbed).wait(600) == 0
    folders = sorted(path.parent for path in undisturbed.glob("quick/*/seed_*/summary.json"))
    assert len(folders) == 21
    for folder in folders:
        same(left(disturbed / folder.relative_to(undisturbed), disturbed), left(folder, undisturbed))


def sweep(out: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, str(ROOT / "run.py"), *MATRIX, f"output_dir={out}"],
        cwd=out.parent, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT, start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def learning(out: Path) -> list[int]:
    """Processes that train a run of a sweep and have made a checkpoint."""
    holders = []
    for folder in {path.parent.parent for path in out.glob("quick/*/seed_*/checkpoint/step_*.json")}:
        match = re.match(r"process (\d+) ", (folder / ".lock").read_text())
        if match and f"@{out}".encode() in Path(f"/proc/{match[1]}/cmdline").read_bytes():
            holders.append(int(match[1]))
    return sorted(holders)


def left(folder: Path, out: Path) -> dict[str, bytes]:
    """What a run of a sweep left, as :meth:`torture.Run.outcome` has it."""
    (out / "buffer.sha256").write_bytes(b"")
    run = Run.__new__(Run)
    run.output = out
    run.spec = type("Spec", (), {"directory": folder})()
    return {name: data for name, data in run.outcome().items() if name != "output.log"}

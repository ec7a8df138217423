"""Kills and signals at random moments, and twenty starts at once. ``ACMR_TORTURE=n``: n times as many."""

import os
import random
import re
import shutil
import signal
import time
from pathlib import Path

import pytest
from torture import ANT, HUMANOID, SMALL, Run, at_step, found_out, same

pytestmark = pytest.mark.slow

ROUNDS = int(os.environ.get("ACMR_TORTURE", "1"))
KINDS = {"humanoid": HUMANOID, "ant": ANT}


@pytest.fixture(scope="module")
def untouched(tmp_path_factory):
    """What undisturbed runs leave, and the seconds that they take."""
    made = {}

    def of(overrides: tuple[str, ...]) -> tuple[dict[str, bytes], float]:
        if overrides not in made:
            # What all of its processes know from the first; else a kill would mostly come after the end.
            found_out(overrides)
            began = time.monotonic()
            outcome = Run(tmp_path_factory.mktemp("untouched"), overrides).finish()
            made[overrides] = outcome, time.monotonic() - began
        return made[overrides]

    return of


def kill_after(run: Run, seconds: float, number: int = signal.SIGKILL) -> int:
    child = run.start()
    until, ended = time.monotonic() + seconds, os.WEXITED | os.WNOWAIT | os.WNOHANG
    # One that came to its end before is not waited for; until it is asked for its code its number is its own.
    while time.monotonic() < until and not os.waitid(os.P_PID, child, ended):
        time.sleep(0.005)
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

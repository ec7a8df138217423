"""A kill at each durable write, and again in the recovery. ``ACMR_TORTURE=n``: n kills of each recovery."""

import os
import random
import shutil
import signal

import pytest
from torture import SHORT, Run, at_step, at_write, count_writes, same

pytestmark = pytest.mark.slow

ROUNDS = int(os.environ.get("ACMR_TORTURE", "1"))


@pytest.fixture(scope="module")
def untouched(tmp_path_factory) -> dict[str, bytes]:
    """What an undisturbed run leaves."""
    return Run(tmp_path_factory.mktemp("untouched"), SHORT).finish()


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
        same(run.finish(), untouched)


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
        same(work.finish() | {"config.yaml": b""}, untouched | {"config.yaml": b""})

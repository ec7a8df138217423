"""A matrix of runs whose trainings and then whose parent are killed, against one that nobody touched."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from torture import Run, same

ROOT = Path(__file__).resolve().parent.parent
#: Only settings that a student shares with its teacher: others would make more runs of it.
MATRIX = (
    "matrix=quick", "tracking=off", "progress=off", "total_timesteps=1200", "agent.hidden_sizes=[16,16]",
    "checkpoint_every=100",
)  # fmt: skip


@pytest.mark.slow
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
        with suppress(FileNotFoundError):
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

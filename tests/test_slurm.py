"""The same sweeps through a real Slurm: one node, real ``sbatch``, real kills."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "tests" / "slurm_one.sh"
PROGRAMS = ("sbatch", "squeue", "scancel", "slurmctld", "slurmd", "munged")
#: Set where Slurm has to be there, as in CI: what is skipped elsewhere fails then.
REQUIRED = "ACMR_REQUIRE_SLURM"
TINY = ("tracking=off", "progress=off", "total_timesteps=300", "hydra/launcher=slurm", "hydra.launcher.mem_gb=2")


def unavailable(reason: str) -> None:
    if os.environ.get(REQUIRED):
        pytest.fail(f"{REQUIRED} is set, but {reason}")
    pytest.skip(f"no Slurm: {reason}")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Callable[..., str]]:
    """A cluster of one node; gives a function that calls its programs."""
    missing = [program for program in PROGRAMS if shutil.which(program, path=f"{os.environ['PATH']}:/usr/sbin") is None]
    if missing:
        unavailable(f"{', '.join(missing)} not installed (apt-get install slurmctld slurmd slurm-client munge ...)")
    if os.getuid() != 0:
        unavailable("a cluster can only be started by root")
    # There is one cluster at a time: tests of this file may run in several processes.
    turn = open(Path(tempfile.gettempdir()) / "acmr-slurm.lock", "w")  # noqa: SIM115 (held until the end)
    fcntl.flock(turn, fcntl.LOCK_EX)
    # Munge's own user has to reach it, which a folder of pytest's forbids.
    folder = Path(tempfile.mkdtemp(prefix="acmr-slurm-"))
    started = subprocess.run(["sh", SCRIPT, "start", folder], capture_output=True, text=True, timeout=60)
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    try:
        if started.returncode:
            unavailable(f"the cluster does not start: {started.stderr.strip()[-600:]}")
        yield lambda *words: subprocess.run(words, capture_output=True, text=True, timeout=30, check=True).stdout
    finally:
        subprocess.run(["sh", SCRIPT, "stop", folder], capture_output=True, timeout=60, check=False)
        del os.environ["SLURM_CONF"]
        shutil.rmtree(folder, ignore_errors=True)
        turn.close()


def start(out: Path, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(ROOT / "run.py"), *words, f"output_dir={out}"],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        cwd=out.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        # A test runner in the background ignores Ctrl-C, and so would what it starts.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def await_that(condition: Callable[[], object], seconds: float = 120) -> object:
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.2)
    return value


def complete(out: Path) -> list[Path]:
    found = sorted(out.glob("*/*/*/summary.json"))
    assert all(json.loads(path.read_text())["status"] == "complete" for path in found)
    return found


@pytest.mark.slow
def test_the_quick_matrix_is_complete_although_a_job_is_killed(cluster, tmp_path):
    out = tmp_path / "runs"
    sweep = start(out, "matrix=quick", *TINY)
    try:
        await_that(lambda: complete(out))
        running = await_that(lambda: cluster("squeue", "-h", "-r", "-t", "R", "-o", "%i").split())
        cluster("scancel", "--signal=KILL", running[-1])
        text = sweep.communicate(timeout=560)[0]
    finally:
        sweep.terminate()
    assert sweep.returncode == 0, text
    assert "21 of 21 runs complete" in text
    assert len(complete(out)) == 21
    assert not cluster("squeue", "-h").strip()
    jobs = [path for path in out.glob(".sweeps/*/slurm/*_*") if path.is_dir()]
    assert len(jobs) == 22, "one job for each run, and one for the run whose job was killed"


@pytest.mark.slow
def test_ctrl_c_takes_the_jobs_out_of_the_queue_and_the_same_command_goes_on(cluster, tmp_path):
    out = tmp_path / "runs"
    words = ["-m", "profile=quick", "experiment=A0", "seed=1,2,3", *TINY]
    sweep = start(out, *words)
    await_that(lambda: list(out.glob("*/*/*/output.log")))
    began = time.monotonic()
    sweep.send_signal(signal.SIGINT)
    text = sweep.communicate(timeout=60)[0]
    assert time.monotonic() - began < 25
    assert sweep.returncode == 130, text
    await_that(lambda: not cluster("squeue", "-h").strip(), 30)
    again = start(out, *words)
    text = again.communicate(timeout=250)[0]
    assert again.returncode == 0, text
    assert len(complete(out)) == 3


@pytest.mark.slow
def test_a_job_that_has_to_leave_its_node_goes_on_from_its_checkpoint(cluster, tmp_path):
    out = tmp_path / "runs"
    words = ["-m", "profile=quick", "experiment=A0", *TINY, "total_timesteps=8000", "agent.learning_starts=100"]
    sweep = start(out, *words)

    def learning() -> bool:
        told = [json.loads(path.read_text()) for path in out.glob("*/*/*/status.json")]
        return any(status["global_step"] > 200 for status in told)

    await_that(learning)
    job = cluster("squeue", "-h", "-r", "-o", "%i").split()[0]
    # What Slurm sends before the time limit, and before it gives the node to somebody else.
    cluster("scancel", "--signal=USR2", job)
    text = sweep.communicate(timeout=200)[0]
    assert sweep.returncode == 0, text
    (run,) = complete(out)
    log = (run.parent / "run.log").read_text()
    assert "resumed at step" in log, log


@pytest.mark.slow
def test_jobs_of_a_sweep_that_was_killed_make_room_for_the_next(cluster, tmp_path):
    out = tmp_path / "runs"
    words = ["-m", "profile=quick", "experiment=A0", "seed=1,2", *TINY, "total_timesteps=8000"]
    sweep = start(out, *words)
    await_that(lambda: len(list(out.glob("*/*/*/status.json"))) == 2)
    sweep.kill()
    sweep.communicate()
    assert cluster("squeue", "-h").strip()
    again = start(out, *words)
    text = again.communicate(timeout=250)[0]
    assert again.returncode == 0, text
    assert len(complete(out)) == 2
    assert len(list(out.glob("*/*/*/output.log"))) == 2

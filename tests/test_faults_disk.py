"""Disks that are full, fail, or may only be read: the last checkpoint stays good, and one line says what to do."""

import errno
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from torture import ANT, SHORT, Run, at_step, at_write, count_writes, fail_with, same

ROOT = Path(__file__).resolve().parent.parent


def error_of(said: str) -> str:
    (line,) = [line for line in said.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in said
    return line


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
@pytest.mark.first_is_fast
@pytest.mark.slow
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


@pytest.mark.slow
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

"""File systems without locks, sizes or syncs, names that are too long, broken teachers: one line, or it goes on."""

from __future__ import annotations

import json
import os
import pty
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch
from finished_run import make_run
from safetensors.torch import load_file
from test_faults import wait_for
from torture import SHORT

from acmr.config import ConfigError
from acmr.storage.hold import RunHeldError, hold
from acmr.transfer.description import FULL
from acmr.transfer.teacher import load_teacher, save_teacher

ROOT = Path(__file__).resolve().parent.parent
#: Fails calls of the C library as the file system does that ACMR_FAIL names: NAME=ERRNO.
SOURCE = """
#include <errno.h>
#include <stdlib.h>
#include <string.h>
static int fail(const char *name) {
    const char *said = getenv("ACMR_FAIL");
    const char *found = said ? strstr(said, name) : 0;
    if (!found) return 0;
    errno = atoi(found + strlen(name));
    return 1;
}
#define REPLACE(name, type, arguments, values) \\
    int name arguments { \\
        if (fail(#name "=")) return -1; \\
        return ((int (*) type) dlsym(RTLD_NEXT, #name)) values; }
#define _GNU_SOURCE
#include <dlfcn.h>
struct statvfs;
REPLACE(flock, (int, int), (int a, int b), (a, b))
REPLACE(fsync, (int), (int a), (a))
REPLACE(statvfs, (const char *, struct statvfs *), (const char *a, struct statvfs *b), (a, b))
REPLACE(statvfs64, (const char *, struct statvfs *), (const char *a, struct statvfs *b), (a, b))
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library that goes before the C library's own."""
    if shutil.which("gcc") is None or sys.platform != "linux":
        pytest.skip("no gcc here")
    folder = tmp_path_factory.mktemp("library")
    (folder / "fail.c").write_text("#define _GNU_SOURCE\n" + SOURCE.replace("#define _GNU_SOURCE\n", ""))
    made = folder / "fail.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", str(made), str(folder / "fail.c"), "-ldl"], check=True)
    return made


def run(out: Path, library: Path, fail: str, *more: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "LD_PRELOAD": str(library), "ACMR_FAIL": fail}
    command = [sys.executable, str(ROOT / "run.py"), *SHORT, f"output_dir={out}", *more]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100)


@pytest.mark.slow
@pytest.mark.parametrize(
    "fail", ["flock=37", "flock=95", "flock=38", "fsync=22", "fsync=95", "statvfs=38,statvfs64=38", "flock=37,fsync=22"]
)
def test_a_run_goes_on_where_the_file_system_lacks_something(fail, library, tmp_path):
    done = run(tmp_path, library, fail)
    assert (done.returncode, done.stderr) == (0, "")
    assert "complete, " in done.stdout
    assert "complete already" in run(tmp_path, library, fail).stdout


@pytest.mark.slow
def test_an_error_of_the_disk_still_ends_it(library, tmp_path):
    done = run(tmp_path, library, "fsync=5")
    assert done.returncode == 74
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("number", [37, 95, 38])
def test_without_locks_a_directory_is_held_by_who_stands_in_it(number, library, tmp_path):
    code = textwrap.dedent("""
        import sys, time
        from pathlib import Path
        from acmr.storage.hold import hold
        with hold(Path(sys.argv[1])):
            print("held", flush=True)
            sys.stdin.read()
    """)
    environment = {**os.environ, "LD_PRELOAD": str(library), "ACMR_FAIL": f"flock={number}", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    first = subprocess.Popen(command, env=environment, **pipes)
    assert first.stdout.readline() == "held\n"
    second = subprocess.run(command, env=environment, capture_output=True, text=True, input="")
    assert f"held by process {first.pid} on" in second.stderr
    first.communicate("")
    assert first.returncode == 0
    assert (tmp_path / ".lock").read_text() == ""
    third = subprocess.run(command, env=environment, capture_output=True, text=True, input="")
    assert (third.returncode, third.stdout) == (0, "held\n")


def test_with_locks_nobody_is_asked(tmp_path):
    with hold(tmp_path), pytest.raises(RunHeldError), hold(tmp_path):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("name", ["x" * 300, "ä" * 150, "a/" * 2500 + "b"])
def test_names_that_no_file_system_takes_are_refused_in_one_line(name, tmp_path):
    command = [sys.executable, str(ROOT / "run.py"), *SHORT, f"output_dir={tmp_path}/{name}"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 2
    assert (done.stderr.count("\n"), "too long" in done.stderr) == (1, True), done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_teacher_with_numbers_that_are_not_finite_is_refused(value, tmp_path):
    folder = make_run(tmp_path / "seed_1")
    teacher = load_teacher(folder)
    assert teacher.description.precision == FULL
    networks = teacher.build_networks()
    name = next(iter(load_file(folder / "teacher.safetensors")))
    with torch.no_grad():
        networks.state_dict()[name].view(-1)[3] = value
    save_teacher(folder, networks, teacher.description)
    with pytest.raises(ConfigError, match=r"teacher\.safetensors: \S+ holds numbers that are not finite") as refused:
        load_teacher(folder)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize("more", ["progress=auto", "progress=off"])
def test_a_terminal_that_is_closed_stops_a_run_in_good_order(more, tmp_path):
    terminal, side = pty.openpty()
    words = [word for word in SHORT if not word.startswith(("total", "progress"))]
    command = [sys.executable, str(ROOT / "run.py"), *words, "total_timesteps=100000", more, f"output_dir={tmp_path}"]
    run = subprocess.Popen(
        ["setsid", "--ctty", "--wait", *command], stdin=side, stdout=side, stderr=side,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    os.close(side)
    wait_for(lambda: list(tmp_path.glob("*/*/seed_1/checkpoint/step_*.json")))
    (status,) = tmp_path.glob("*/*/seed_1/status.json")
    # What the terminal's closing sends, to the process that has it.
    os.close(terminal)
    assert run.wait(60) == 129
    assert json.loads(status.read_text())["state"] == "stopped"
    assert "stopped by SIGHUP at step" in (status.parent / "run.log").read_text()

"""Everything that can go wrong with a mirror, for real: kills, a full disk, a dead service, a hostile environment."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from tracking_tools import ID, child, history, records, start, the_mirror

from acmr.tracking import wandb_tracker


def test_an_unfinished_tracker_does_not_keep_a_process(tmp_path: Path) -> None:
    process = child("start().on_metrics(1, {'alpha': 1.0})", tmp_path / "out", home=tmp_path)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (0, "", "")
    assert len(history(the_mirror(tmp_path / "out"))) == 1


def test_a_folder_whose_name_is_no_text_costs_one_line(tmp_path: Path) -> None:
    out = tmp_path / os.fsdecode(b"n\xff")
    process = child("start().close({})", out, home=tmp_path)
    said, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    (line,) = said.splitlines()
    assert line.startswith("WARNING W&B mirror not started: UnicodeEncodeError")


@pytest.mark.slow
def test_kill_9_costs_the_last_second_at_most(tmp_path: Path) -> None:
    program = """
        tracker = start()
        print(service()[0], flush=True)
        for step in range(1, 10**6):
            tracker.on_metrics(step, {"alpha": 1.0 / step})
            print(step, time.time(), flush=True)
            time.sleep(0.05)  # too few rows to fill a block of W&B's file, which is written at once
    """
    process = child(program, tmp_path / "out", home=tmp_path)
    assert process.stdout is not None
    lines = [process.stdout.readline()]
    until = time.monotonic() + 2.3
    while time.monotonic() < until:
        lines.append(process.stdout.readline())
    killed = time.time()
    os.kill(int(lines[0]), signal.SIGKILL)  # W&B's service too, as when the machine goes down
    process.kill()
    process.wait()
    rows = [line.split() for line in lines[1:]]
    lasting = [int(step) for step, logged in rows if float(logged) < killed - 1.3]
    time.sleep(0.5)
    assert len(lasting) > 10
    steps = [row["global_step"] for row in history(the_mirror(tmp_path / "out"))]
    assert steps[: len(lasting)] == lasting


def test_the_users_variables_neither_break_nor_steer_it(tmp_path: Path) -> None:
    variables = {
        "WANDB_MODE": "disabled",
        "WANDB_DISABLED": "true",
        "WANDB_RUN_ID": "other",
        "WANDB_NAME": "other",
        "WANDB_PROJECT": "other",
        "WANDB_RESUME": "must",
        "WANDB_DIR": "/nowhere",
        "WANDB_TAGS": "a,b",
        "WANDB_SWEEP_ID": "sweep",
        "WANDB_SERVICE": "2-1-tcp-localhost-1",
        "WANDB_BASE_URL": "no address",
    }
    program = f"""
        before = dict(os.environ)
        tracker = start()
        tracker.on_metrics(1, {{"alpha": 1.0}})
        tracker.close(None)
        assert dict(os.environ) == before
        assert os.environ["WANDB_RUN_ID"] == "other"
        assert not service()
        print(sorted(path.name for path in Path({str(tmp_path)!r}).iterdir()))
    """
    process = child(program, tmp_path / "out", home=tmp_path, variables=variables)
    out, err = process.communicate(timeout=20)
    # Nothing is written into the home folder.
    assert (process.returncode, out, err) == (0, "['out']\n", "")
    (run,) = [record["run"] for record in records(the_mirror(tmp_path / "out")) if record["type"] == "run"]
    assert (run["run_id"], run["project"]) == (ID, "acmr")
    assert set(run["tags"]) == {"A2", "ant_three_legs", "frozen", "hidden", "quick", "seed3"}


def test_off_does_not_even_import_wandb(tmp_path: Path) -> None:
    program = """
        tracker = start(OFF)
        tracker.on_episode(EpisodeRecord(1, 1.0, 1))
        tracker.on_metrics(1, {})
        tracker.close({})
        print([name for name in sys.modules if name.startswith("wandb")], os.listdir(sys.argv[1]))
    """
    process = child(program, tmp_path, home=tmp_path)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (0, "[] []\n", "")


FAILURES = {
    "the folder cannot be made": ("", "Path(sys.argv[1]).write_text('a file')", "mirror not started: "),
    "the service dies": ("os.kill(service()[0], signal.SIGKILL); time.sleep(0.1)", "", "mirror stopped: "),
    # What the file system does when the disk is full, for this process and its children only.
    "the disk is full": (
        "",
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))",
        "mirror stopped: OSError: rows no longer reach ",
    ),
    "the folder vanishes": ("import shutil; shutil.rmtree(sys.argv[1])", "", "mirror stopped: FileNotFoundError: "),
}


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.first_is_fast
def test_a_failure_costs_one_warning_and_never_the_run(tmp_path: Path, failure: str) -> None:
    later, before, warning = FAILURES[failure]
    program = f"""
        {before}
        tracker = start()
        for step in range(1, 2001):
            tracker.on_metrics(step, {{f"value_{{index}}": step / 3 + index for index in range(9)}})
            if step == 10:
                pass; {later}
            if step % 500 == 0:
                tracker.on_episode(EpisodeRecord(step, 1.0, 1))
        began = time.monotonic()
        tracker.close({{"status": "complete"}})
        assert time.monotonic() - began < 5
        print("trained")
    """
    process = child(program, tmp_path / "out", home=tmp_path)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (0, "")
    said, trained = out.splitlines()
    assert said.startswith(f"WARNING W&B {warning}")
    assert "the run goes on" in said.lower()
    assert trained == "trained"


@pytest.mark.slow
def test_rows_that_stop_arriving_are_noticed_during_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wandb_tracker, "ARRIVAL_CHECK", 1.2)
    warnings: list[str] = []
    tracker = start(tmp_path, warnings)
    until = time.monotonic() + 2.6
    while time.monotonic() < until:
        tracker.on_metrics(1, {"alpha": 1.0})
        time.sleep(0.3)
    assert warnings == []
    mirror = the_mirror(tmp_path)
    file = mirror / f"run-{ID}.wandb"
    file.rename(mirror / "moved")
    file.write_bytes(b"")
    until = time.monotonic() + 4
    while not warnings and time.monotonic() < until:
        tracker.on_metrics(1, {"alpha": 1.0})
        time.sleep(0.3)
    tracker.on_metrics(1, {"alpha": 1.0})
    tracker.close(None)
    (warning,) = warnings
    assert "rows no longer reach" in warning
    assert "MB free" in warning

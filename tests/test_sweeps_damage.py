"""Files in ``.sweeps/`` that are damaged: no later sweep and no ``make status`` stops at them."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from test_sweeps_run import complete, run
from test_sweeps_status import entry, heartbeat, sweep

from acmr.config import ConfigError
from sweeps.folder import SweepFolder, all_folders
from sweeps.job import adopt
from sweeps.state import State
from sweeps.status import main
from sweeps.worker import Worker


def write(data: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(data)


def change(**more: object) -> Callable[[Path], None]:
    return lambda path: path.write_text(json.dumps(json.loads(path.read_text()) | more))


def change_run(**more: object) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        plan = json.loads(path.read_text())
        plan["runs"][0] |= more
        path.write_text(json.dumps(plan))

    return apply


def exchange(make: Callable[[Path], None]) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        path.unlink()
        make(path)

    return apply


#: What may have become of any file.
ANY = {
    "empty": write(b""),
    "zeros": write(bytes(4096)),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "no text": write(b"\xff\xfe{}"),
    "a list": write(b"[]"),
    "null": write(b"null"),
    "deep": write(b"[" * 200_000),
    "a pipe": exchange(lambda path: os.mkfifo(path)),
    "a folder": exchange(lambda path: path.mkdir()),
    "a link to itself": exchange(lambda path: path.symlink_to(path)),
    "endless": exchange(lambda path: path.symlink_to("/dev/zero")),
}
PLANS = ANY | {
    "no runs": change(runs=None),
    "a run of another kind": change(runs=[1]),
    "a run without a seed": lambda path: path.write_text(path.read_text().replace('"seed"', '"sead"')),
    "a name that is a number": change_run(name=3),
    "a place elsewhere": change_run(directory="../../etc"),
    "the root": change_run(directory="/etc/x"),
    "its own teacher": change_run(teacher=0),
    "a seed that is text": change_run(seed="1"),
    "a seed below zero": change_run(seed=-1),
    "an order that is none": change(order="all"),
}
STATES = ANY | {
    "another word": write(b'{"state": "sleeping", "failures": 0, "reason": ""}'),
    "a count that is text": write(b'{"state": "failed", "failures": "3", "reason": ""}'),
    "more": write(b'{"state": [], "failures": 0, "reason": "", "x": 1}'),
}


@pytest.mark.parametrize("damage", PLANS)
def test_the_plan_of_a_sweep_that_is_over_is_set_aside(damage, tmp_path, capsys):
    old, new = (sweep(tmp_path, entry(number)) for number in (0, 0))
    for folder in (old, new):
        folder.release()
    PLANS[damage](old.path / "plan.json")
    heartbeat(tmp_path / "quick/run0/seed_0", "stopped")
    assert main([str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert "1 runs" in said.out
    assert said.err.startswith(f"warning: {old.path}/plan.json: ")
    assert "its plan is set aside as plan.json.damaged" in said.err
    assert said.err.count("\n") == 1
    # It is said once, and nothing is lost.
    assert main([str(tmp_path)]) == 0
    assert capsys.readouterr().err == ""
    assert os.path.lexists(old.path / "plan.json.damaged")
    assert [folder.path for folder in all_folders(tmp_path)] == [new.path]


@pytest.mark.parametrize("damage", ["empty", "cut", "a pipe"])
def test_the_plan_of_a_sweep_at_work_stays_where_it_is(damage, tmp_path):
    folder, said = sweep(tmp_path, entry(0)), []
    PLANS[damage](folder.path / "plan.json")
    assert all_folders(tmp_path, said.append) == []
    assert "still at work" in said[0]
    assert os.path.lexists(folder.path / "plan.json")
    with pytest.raises(ConfigError, match=r"plan\.json: .*; start the sweep's command again"):
        Worker(SweepFolder(folder.path), 0)
    folder.release()


@pytest.mark.parametrize("damage", STATES)
def test_a_state_that_cannot_be_read_counts_as_waiting(damage, tmp_path, capsys):
    folder = sweep(tmp_path, entry(0), entry(1))
    folder.set_state(0, State("failed", 1, "x"))
    folder.set_state(1, State("failed", 1, "the other"))
    STATES[damage](folder.path / "states" / "00000.json")
    assert folder.state(0) == State()
    assert main([str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert "the other" in said.out
    assert said.err == ""
    folder.release()


@pytest.mark.parametrize("kind", ["a folder", "a pipe", "nothing"])
def test_a_lock_that_is_none_is_not_waited_for(kind, tmp_path):
    folder = sweep(tmp_path, entry(0))
    folder.release()
    for path in (folder.path / "alive", folder.path / "claims" / "00000"):
        path.unlink(missing_ok=True)
        if kind != "nothing":
            (os.mkfifo if kind == "a pipe" else Path.mkdir)(path)
    # A process number of this machine stands in the plan where no lock tells; this one's.
    assert SweepFolder(folder.path).is_alive() == (kind == "a folder")
    with folder.claim(0) as mine:
        assert mine


@pytest.mark.parametrize("damage", ANY)
def test_settings_of_a_run_that_cannot_be_read_are_said_in_one_line(damage, tmp_path, monkeypatch):
    folder = sweep(tmp_path, entry(0))
    monkeypatch.setattr("sweeps.job._die_with_parent", lambda parent: None)
    folder.job_file(0).write_text('{"config": {}, "changes": {}, "name": "x", "cell": null}')
    ANY[damage](folder.job_file(0))
    with pytest.raises(ConfigError, match=r"00000\.json: damaged .*; start the sweep's command again") as refused:
        adopt(folder.job_file(0))
    assert "\n" not in str(refused.value)
    folder.release()


@pytest.mark.parametrize("kind", ["a pipe", "a folder", "a link out", "a link nowhere"])
def test_output_that_cannot_be_kept_fails_its_run_in_one_line(kind, tmp_path):
    folder = sweep(tmp_path, entry(0))
    output = tmp_path / folder.entries()[0].directory / "output.log"
    output.parent.mkdir(parents=True, exist_ok=True)
    outside = tmp_path / "outside"
    outside.write_text("theirs")
    {
        "a pipe": os.mkfifo,
        "a folder": Path.mkdir,
        "a link out": lambda path: path.symlink_to(outside),
        "a link nowhere": lambda path: path.symlink_to(tmp_path / "gone"),
    }[kind](output)
    Worker(folder, 0).take(0)
    assert folder.state(0) == State("failed", 1, f"{output}: no regular file")
    assert outside.read_text() == "theirs"
    assert not (tmp_path / "gone").exists()
    folder.release()


def test_new_sweeps_are_made_beside_damaged_ones(tmp_path):
    for damage in list(PLANS)[:6]:
        folder = sweep(tmp_path, entry(0))
        folder.release()
        PLANS[damage](folder.path / "plan.json")
    last = sweep(tmp_path, entry(0))
    assert [folder.path for folder in all_folders(tmp_path)] == [last.path]
    last.release()


@pytest.mark.slow
def test_a_sweep_trains_beside_damaged_ones_and_begins_anew_what_is_from_the_future(tmp_path):
    out = tmp_path / "runs"
    words = (
        "-m",
        "env=ant",
        "seed=1,2",
        "total_timesteps=150",
        "profile=quick",
        "tracking=off",
        "agent.learning_starts=100",
    )
    assert run(out, *words).returncode == 0
    (folder,) = all_folders(out)
    for damage in ("empty", "a pipe", "deep"):
        shutil.copytree(folder.path, folder.path.with_name(f"copy-{damage}"))
        PLANS[damage](folder.path.with_name(f"copy-{damage}") / "plan.json")
    before = {path: path.stat().st_ino for path in complete(out)}
    for path in before:
        os.utime(path.with_name("config.yaml"), (2**33, 2**33))
    done = run(out, *words, "force=true")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr.count("set aside as plan.json.damaged") == 3
    assert "2 runs, 0 done, 2 to train" in done.stdout
    after = {path: path.stat().st_ino for path in complete(out)}
    assert after.keys() == before.keys()
    assert all(path.with_name("config.yaml").stat().st_mtime < 2**33 for path in after)
    newest = all_folders(out)[-1]
    assert [newest.has_begun(index) for index in (0, 1)] == [True, True]

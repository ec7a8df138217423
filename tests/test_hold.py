"""A run's directory is its own: removed, replaced or taken by another process, nothing more is written by its names."""

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from test_faults import wait_for
from torture import ANT, SHORT, Run, at_step, same

from acmr.storage.durable import Appender, make_folder, remove, sync_folder, write_bytes
from acmr.storage.hold import LostError, RunHeldError, hold
from acmr.storage.json_files import replace_json, write_json


def removed(folder: Path) -> None:
    shutil.rmtree(folder)


def moved(folder: Path) -> None:
    folder.rename(folder.with_name("elsewhere"))


def made_again(folder: Path) -> None:
    shutil.rmtree(folder)
    (folder / "checkpoint").mkdir(parents=True)
    for name in (".lock", "episodes.csv", "summary.json", "status.json", "checkpoint/step_40.json"):
        (folder / name).write_text("another run's\n")


def copied(folder: Path) -> None:
    shutil.copytree(folder, folder.with_name("copy"))
    shutil.rmtree(folder)
    folder.with_name("copy").rename(folder)


def linked_elsewhere(folder: Path) -> None:
    shutil.rmtree(folder)
    other = folder.with_name("other")
    other.mkdir()
    folder.symlink_to(other)


def a_file(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.write_text("no folder any more\n")


def lock_removed(folder: Path) -> None:
    (folder / ".lock").unlink()


def lock_linked(folder: Path) -> None:
    (folder / ".lock").rename(folder / "lock")
    (folder / ".lock").symlink_to("/dev/null")


LOSSES = [removed, moved, made_again, copied, linked_elsewhere, a_file, lock_removed, lock_linked]


def contents(folder: Path) -> dict[str, object]:
    if not folder.is_dir():
        return {"": folder.read_bytes() if folder.exists() else None}
    return {str(path.relative_to(folder)): path.is_file() and path.read_bytes() for path in folder.rglob("*")}


@pytest.mark.parametrize("lose", LOSSES)
def test_whoever_lost_the_directory_writes_nothing_there(lose, tmp_path):
    folder = tmp_path / "seed_1"
    with hold(folder):
        make_folder(folder / "checkpoint")
        log = Appender(folder / "episodes.csv")
        log.append(b"1\n")
        lose(folder)
        before = contents(folder)
        for write in (
            lambda: write_bytes(folder / "summary.json", b"{}"),
            lambda: write_json(folder / "checkpoint" / "step_40.json", {}),
            lambda: replace_json(folder / "status.json", {}),
            lambda: make_folder(folder / "checkpoint"),
            lambda: Appender(folder / "metrics.csv"),
            lambda: remove(folder / "summary.json"),
            lambda: sync_folder(folder),
            lambda: log.append(b"2\n"),
            log.sync,
        ):
            with pytest.raises(LostError, match="removed or replaced while this run was at work in it"):
                write()
        assert contents(folder) == before


@pytest.mark.parametrize("keep", ["moved behind a link", "the parent too", "by another name"])
def test_a_directory_that_is_still_reached_is_kept(keep, tmp_path):
    parent = tmp_path / "runs"
    folder = parent / "seed_1"
    with hold(folder):
        if keep == "moved behind a link":
            folder.rename(tmp_path / "disk")
            folder.symlink_to(tmp_path / "disk")
        elif keep == "the parent too":
            parent.rename(tmp_path / "disk")
            parent.symlink_to(tmp_path / "disk")
        else:
            (tmp_path / "name").symlink_to(folder)
        write_bytes(folder / "summary.json", b"{}")
        write_bytes(tmp_path / "elsewhere", b"is nobody's")
    # Freed: what is written there later is another's affair.
    shutil.rmtree(folder.resolve())
    write_bytes(tmp_path / "elsewhere", b"again")


def test_a_directory_is_held_once(tmp_path):
    with hold(tmp_path), pytest.raises(RunHeldError, match=f"held by process {os.getpid()} on"), hold(tmp_path):
        pass
    with hold(tmp_path):
        pass


def lose_at(number: int, lose: Callable[[Path], None], folder: Path) -> Callable[[], None]:
    return at_step(number, lambda: lose(folder))


@pytest.mark.parametrize("lose", [removed, made_again, moved, lock_removed])
def test_a_run_that_loses_its_directory_stops_in_one_line(lose, tmp_path):
    run = Run(tmp_path, SHORT)
    there: dict[str, object] = {}
    ended = run(lose_at(45, lose, run.folder))
    assert ended.code == 74, ended.said
    errors = [line for line in ended.said.splitlines() if "error" in line]
    assert len(errors) == 1, ended.said
    assert errors[0].startswith(f"error: {run.folder}: removed or replaced while this run was at work in it")
    assert "Traceback" not in ended.said
    there = contents(run.folder)
    if lose is made_again:
        assert {there[name] for name in ("episodes.csv", "summary.json", "status.json")} == {b"another run's\n"}
        assert there["checkpoint/step_40.json"] == b"another run's\n"
    elif lose is lock_removed:
        assert "summary.json" not in there
    else:
        assert there == {"": None}


def test_a_directory_that_goes_while_a_checkpoint_is_made_is_told_like_any_other_time(tmp_path):
    def remove_before_pruning() -> None:
        from acmr.storage.checkpoint_store import SnapshotStore

        prune = SnapshotStore.prune

        def gone(store, files) -> None:
            shutil.rmtree(store.folder.parent)
            prune(store, files)

        SnapshotStore.prune = gone

    ended = Run(tmp_path, ANT)(remove_before_pruning)
    assert (ended.code, "removed or replaced" in ended.said) == (74, True), ended.said


def test_a_run_begun_anew_is_not_disturbed_by_the_old_process(untouched, tmp_path):
    run, go_on = Run(tmp_path, ANT), tmp_path / "go on"

    def wait() -> None:
        while not go_on.exists():
            time.sleep(0.02)

    old = run.start(at_step(100, wait))
    wait_for(lambda: run.checkpoints)
    shutil.rmtree(run.folder)
    same(run.finish(), untouched(ANT))
    go_on.touch()
    ended = run.wait(old)
    assert (ended.code, "removed or replaced" in ended.said) == (74, True), ended.said
    go_on.unlink()
    finished = run()
    assert (finished.code, "complete already" in finished.said) == (0, True), finished.said

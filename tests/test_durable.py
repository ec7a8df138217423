"""Each durable write, failed and killed at each of its steps."""

import errno
import os
import signal
import stat
from pathlib import Path

import pytest

from acmr.records import DamagedError
from acmr.storage import durable
from acmr.storage.durable import (
    Appender,
    FileDigest,
    WriteError,
    make_folder,
    read_checked,
    read_regular,
    remove_tree,
    write_bytes,
)


@pytest.fixture(autouse=True)
def _no_hook():
    yield
    durable.hook = None


def steps_of(action) -> list[str]:
    names: list[str] = []
    durable.hook = lambda name, path: names.append(name)
    action()
    durable.hook = None
    return names


def fail_at(number: int, error: BaseException) -> None:
    count = 0

    def hook(name: str, path: Path) -> None:
        nonlocal count
        count += 1
        if count == number:
            raise error

    durable.hook = hook


def in_a_child(action) -> int:
    child = os.fork()
    if child == 0:
        try:
            action()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_file_is_there_whole_or_not_at_all_wherever_the_process_dies(tmp_path):
    path, old, new = tmp_path / "file", b"old" * 1000, b"new!" * 2000
    write_bytes(path, old)
    names = steps_of(lambda: write_bytes(path, new))
    assert names == ["create", "write", "write", "sync", "rename", "sync folder"]
    for number in range(1, len(names) + 1):
        write_bytes(path, old)

        def die_there(number=number):
            count = 0

            def hook(name: str, path: Path) -> None:
                nonlocal count
                count += 1
                if count == number:
                    os.kill(os.getpid(), signal.SIGKILL)

            durable.hook = hook
            write_bytes(path, new)

        assert in_a_child(die_there) == -signal.SIGKILL
        assert path.read_bytes() == (old if number <= 5 else new)
        durable.remove_leftovers(tmp_path)
        assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("number", range(1, 7))
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_a_failed_write_leaves_the_old_content_and_no_litter(number, code, tmp_path):
    path = tmp_path / "file"
    write_bytes(path, b"old")
    fail_at(number, OSError(code, os.strerror(code)))
    with pytest.raises(WriteError, match=os.strerror(code)) as caught:
        write_bytes(path, b"new")
    assert caught.value.errno == code
    assert path.read_bytes() == (b"old" if number <= 5 else b"new")
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_noticed_in_the_middle_of_a_file(tmp_path):
    import resource

    def too_large():
        resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
        try:
            write_bytes(tmp_path / "file", bytes(9000))
        except WriteError as error:
            os._exit(7 if error.errno == errno.EFBIG else 8)

    write_bytes(tmp_path / "file", b"old")
    assert in_a_child(too_large) == 7
    assert (tmp_path / "file").read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_an_appended_file_is_cut_back_to_what_was_marked(tmp_path):
    path = tmp_path / "log"
    log = Appender(path)
    for row in range(20):
        log.append(f"{row}\n".encode())
    digest = log.sync()
    log.append(b"torn ro")
    log.close()
    again = Appender(path, digest)
    assert path.read_bytes() == b"".join(f"{row}\n".encode() for row in range(20))
    again.append(b"more\n")
    assert again.sync() == FileDigest.of(path.read_bytes())
    again.close()


@pytest.mark.parametrize("damage", [lambda data: data[:-1], lambda data: b"x" + data[1:], lambda data: b""])
def test_an_appended_file_that_was_changed_is_left_as_it_is(damage, tmp_path):
    path = tmp_path / "log"
    log = Appender(path)
    log.append(b"one\ntwo\n")
    digest = log.sync()
    log.close()
    path.write_bytes(damage(path.read_bytes()))
    before = path.read_bytes()
    with pytest.raises(DamagedError, match="log: does not hold what was written to it"):
        Appender(path, digest)
    assert path.read_bytes() == before


def test_a_whole_file_must_hold_nothing_else(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"contentmore")
    assert read_checked(path, FileDigest.of(b"content")) == b"content"
    with pytest.raises(DamagedError, match="11 bytes, at most 7"):
        read_checked(path, FileDigest.of(b"content"), whole=True)


def test_no_link_is_followed_and_nothing_else_is_read(tmp_path):
    outside, inside = tmp_path / "outside", tmp_path / "inside"
    outside.mkdir()
    inside.mkdir()
    target = outside / "target"
    target.write_bytes(b"theirs")
    (inside / "link").symlink_to(target)
    with pytest.raises(DamagedError):
        read_regular(inside / "link", None)
    with pytest.raises(WriteError):
        Appender(inside / "link")
    (inside / f".file.{os.getpid()}.tmp").symlink_to(target)
    write_bytes(inside / "file", b"ours")
    write_bytes(inside / "link", b"ours")
    assert target.read_bytes() == b"theirs"
    assert (inside / "link").read_bytes() == b"ours"
    os.mkfifo(inside / "pipe")
    with pytest.raises(DamagedError, match="no regular file"):
        read_regular(inside / "pipe", None)
    (inside / "folder").symlink_to(outside)
    with pytest.raises(WriteError, match="it is a link"):
        make_folder(inside / "folder")
    assert stat.S_ISLNK((inside / "folder").lstat().st_mode)


@pytest.mark.parametrize("kind", ["folder", "pipe", "link", "file", "nothing"])
def test_whatever_has_a_name_is_removed_and_nothing_beyond_it(kind, tmp_path):
    outside, place = tmp_path / "outside", tmp_path / "place"
    outside.mkdir()
    (outside / "theirs").touch()
    if kind == "folder":
        (place / "inner").mkdir(parents=True)
        (place / "link").symlink_to(outside)
        os.mkfifo(place / "inner" / "pipe")
    else:
        {"pipe": os.mkfifo, "link": lambda path: path.symlink_to(outside), "file": Path.touch}.get(kind, str)(place)
    remove_tree(place)
    assert not os.path.lexists(place)
    assert (outside / "theirs").exists()

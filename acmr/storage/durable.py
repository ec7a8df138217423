"""Every write that must survive a crash goes through here, one small step at a time, so that tests can fail each step.

Before each step it is looked whether the run's directory is still this process's (:mod:`acmr.storage.hold`).

A file is written whole under another name, reaches the disk, and then takes its name; or it only grows, and what it
held at some moment is known by length and hash. No link is followed.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acmr.config import ConfigError
from acmr.foreign import opened
from acmr.records import DamagedError
from acmr.storage.hold import check_hold

#: Called with an action and a file before each step; a test may raise OSError here, or end the process.
hook: Callable[[str, Path], None] | None = None

_CREATE = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
#: Not to wait for the reader of a pipe.
_APPEND = _CREATE | os.O_APPEND | os.O_NONBLOCK
_TEMPORARY = re.compile(r"\..*\.tmp")

#: What to do about an error of the disk.
_REMEDIES = {
    errno.ENOSPC: "free some space there",
    errno.EDQUOT: "free some of your quota there",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f)",
    errno.EACCES: "make it writable",
    errno.EPERM: "make it writable",
    errno.EROFS: "make it writable",
    errno.EIO: "see to that disk",
}


class WriteError(Exception):
    """The disk did not take something. The message says which file and why."""

    def __init__(self, path: Path, error: OSError) -> None:
        super().__init__(f"cannot write {path} ({error.strerror or error})")
        self.errno = error.errno


class StorageError(ConfigError):
    """The disk does not take what the run has to store."""

    exit_code = 74

    def __init__(self, run_dir: Path, error: WriteError, latest: int | None = None) -> None:
        remedy = _REMEDIES.get(error.errno or 0, "mend that")
        then = f"; it resumes at step {latest:,}" if latest else ""
        super().__init__(f"{run_dir}: {error}; {remedy}, then run the same command again{then}")


@dataclass(frozen=True)
class FileDigest:
    """What a file held at some moment: so many bytes, with this sha256 (hex)."""

    size: int
    sha256: str

    @staticmethod
    def of(data: bytes) -> FileDigest:
        """The digest of a whole content."""
        return FileDigest(len(data), hashlib.sha256(data).hexdigest())

    def to_json(self) -> list[int | str]:
        """As JSON holds it."""
        return [self.size, self.sha256]

    @staticmethod
    def from_json(entry: Any) -> FileDigest:
        """Reverses :meth:`to_json`.

        Raises:
            ValueError, TypeError: If it is no digest.
        """
        size, sha256 = entry
        if not isinstance(size, int) or not isinstance(sha256, str) or size < 0:
            raise ValueError("no digest of a file")
        return FileDigest(size, sha256)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file whole or not at all: whoever reads ``path`` sees the old content or the new one.

    Raises:
        WriteError: If the disk does not take it; the old content is untouched then.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with _step("create", path):
            temporary.unlink(missing_ok=True)
            descriptor = os.open(temporary, _CREATE | os.O_EXCL, 0o644)
        try:
            middle = len(data) // 2
            _write(descriptor, path, data[:middle])
            _write(descriptor, path, data[middle:])
            with _step("sync", path):
                _fsync(descriptor)
        finally:
            os.close(descriptor)
        with _step("rename", path):
            os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def make_folder(path: Path) -> None:
    """Makes a folder in an existing one.

    Raises:
        WriteError: If it cannot be made, or if something else has its name, a link included.
    """
    with _step("make folder", path):
        path.mkdir(exist_ok=True)
        if path.is_symlink():
            raise OSError("it is a link")
    sync_folder(path.parent)


def remove(path: Path) -> None:
    """Removes a file if there is one."""
    with _step("remove", path):
        path.unlink(missing_ok=True)


def remove_tree(path: Path) -> None:
    """Removes whatever has a name: a folder with all that is in it, but of a link or a pipe itself only.

    Raises:
        OSError: If that cannot be done; where there is nothing, nothing is.
    """
    with suppress(FileNotFoundError):
        # What is no folder is not even opened by that function: it would wait for the writer of a pipe.
        if stat.S_ISDIR(os.lstat(path).st_mode):
            shutil.rmtree(path)
        else:
            path.unlink()


def remove_leftovers(folder: Path) -> None:
    """Removes what killed processes had begun to write."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if _TEMPORARY.fullmatch(path.name):
            remove(path)


def sync_folder(folder: Path) -> None:
    """Makes the names in a folder durable."""
    with _step("sync folder", folder):
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            _fsync(descriptor)
        finally:
            os.close(descriptor)


def open_to_append(path: Path) -> int:
    """Opens a file that grows, and makes it where there is none; its descriptor.

    Raises:
        OSError: If that cannot be done, or something else than a regular file has its name, a link or a pipe.
    """
    with suppress(FileNotFoundError):
        _check_regular(os.lstat(path), path)
    descriptor = os.open(path, _APPEND, 0o644)
    try:
        _check_regular(os.fstat(descriptor), path)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _check_regular(status: os.stat_result, path: Path) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "no regular file", str(path))


class Appender:
    """A file that only grows.

    Args:
        path: The file.
        digest: What it is to be cut back to; None: it is begun anew.

    Raises:
        DamagedError: If it does not begin with that; nothing has been changed then.
        WriteError: If it cannot be written.
    """

    def __init__(self, path: Path, digest: FileDigest | None = None) -> None:
        self._path = path
        held = b"" if digest is None else read_checked(path, digest)
        with _step("open", path):
            self._descriptor = open_to_append(path)
            os.ftruncate(self._descriptor, len(held))
        self._hash, self._bytes = hashlib.sha256(held), len(held)

    def append(self, data: bytes) -> None:
        """Appends; it reaches the disk with the next :meth:`sync`."""
        _write(self._descriptor, self._path, data)
        self._hash.update(data)
        self._bytes += len(data)

    def sync(self) -> FileDigest:
        """Waits until everything is on the disk, and says what that is."""
        with _step("sync", self._path):
            _fsync(self._descriptor)
        return FileDigest(self._bytes, self._hash.hexdigest())

    def close(self) -> None:
        """Closes the file."""
        os.close(self._descriptor)


def read_checked(path: Path, digest: FileDigest, whole: bool = False) -> bytes:
    """Reads what a digest was made of.

    Args:
        path: The file.
        digest: Its digest.
        whole: Whether the file must hold nothing else.

    Raises:
        DamagedError: If the file does not begin with that, or is longer though it should not be.
    """
    data = read_regular(path, digest.size if whole else None, digest.size)
    if FileDigest.of(data) != digest:
        raise DamagedError(f"{path}: does not hold what was written to it")
    return data


def read_regular(path: Path, limit: int | None, count: int = -1) -> bytes:
    """Reads a regular file, no link.

    Args:
        path: The file.
        limit: Bytes it may have; None: any number.
        count: Bytes to read; -1: all.

    Raises:
        DamagedError: If it is missing, unreadable, no regular file, or larger.
    """
    with opened(path, links=False) as (stream, size):
        if limit is not None and size > limit:
            raise DamagedError(f"{path}: {size} bytes, at most {limit} expected")
        return stream.read(min(count, size) if count >= 0 else -1)


def _fsync(descriptor: int) -> None:
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Such a file system has nothing to wait for, or no way to ask for it.
        if error.errno not in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
            raise


def _write(descriptor: int, path: Path, data: bytes) -> None:
    with _step("write", path):
        view = memoryview(data)
        while view:
            view = view[os.write(descriptor, view) :]


@contextmanager
def _step(action: str, path: Path) -> Iterator[None]:
    try:
        if hook is not None:
            hook(action, path)
        check_hold(path)
        yield
    except OSError as error:
        raise WriteError(path, error) from error

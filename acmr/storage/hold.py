"""The hold of a run's directory: a lock that ends with its process, and whether that still is the directory's.

A lock belongs to a file, not to its name: a directory that is removed and made again has another one, which another
process may hold. So before each durable write (:mod:`acmr.storage.durable`) the locked file is compared with the one
that has its name by now, and whoever lost the directory writes nothing more by names within it.
"""

from __future__ import annotations

import errno
import fcntl
import os
import platform
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from acmr.config import ConfigError
from acmr.storage.processes import is_alive

LOCK_FILE = ".lock"
#: What a file system says that has no locks.
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
#: Seconds in which who has just taken a directory must have said so.
_INTRODUCTION = 5.0
#: How often a directory is looked for again that is removed while it is taken.
_TRIES = 20
#: Directories that this process holds, with the descriptor of the locked file.
_held: dict[Path, int] = {}


class RunHeldError(ConfigError):
    """Another process is at work on the run."""

    exit_code = 75


class LostError(ConfigError):
    """The directory that this process holds was removed or replaced."""

    exit_code = 74

    def __init__(self, folder: Path) -> None:
        super().__init__(
            f"{folder}: removed or replaced while this run was at work in it, so it stops; what is there now was not "
            "touched. Type the same command again where you want it"
        )


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Holds a directory for this process, makes it first if there is none, and frees it however the process ends.

    Raises:
        RunHeldError: If another process holds it, saying which.
        OSError: If it cannot be made or locked.
    """
    descriptor = _take(folder)
    try:
        holder = f"process {os.getpid()} on {platform.node()} since {time.strftime('%Y-%m-%d %H:%M:%S')}\n"
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, holder.encode(), 0)
        _held[folder] = descriptor
        yield
    finally:
        _held.pop(folder, None)
        with suppress(OSError):
            os.ftruncate(descriptor, 0)
        os.close(descriptor)


def check_hold(path: Path) -> None:
    """Sees that a path within a directory that this process holds still leads there; elsewhere nothing is looked at.

    Raises:
        LostError: If it was removed, or something else has its place.
        OSError: If that cannot be found out.
    """
    for folder, descriptor in _held.items():
        if (folder == path or folder in path.parents) and not _is_at(folder, descriptor):
            raise LostError(folder)


def _take(folder: Path) -> int:
    """The descriptor of a directory's lock file, locked."""
    for _ in range(_TRIES):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        except FileNotFoundError:
            continue
        try:
            _lock(folder, descriptor)
            # Between the two calls the file may have lost its name, and another one may have it.
            if _is_at(folder, descriptor):
                return descriptor
        except BlockingIOError:
            holder = _holder(descriptor)
            os.close(descriptor)
            raise RunHeldError(f"{folder}: held by {holder}; wait for it or end it") from None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
    raise OSError(0, "it is removed again and again")


def _lock(folder: Path, descriptor: int) -> None:
    """Locks a file; where the file system has no locks, whoever stands in it and is still there has it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        holder = _said(descriptor)
        if holder is not None and holder[1] != os.getpid():
            raise RunHeldError(f"{folder}: held by {holder[0]}; wait for it or end it") from None


def _is_at(folder: Path, descriptor: int) -> bool:
    """Whether an open lock file is the one that a directory has now."""
    try:
        there = os.stat(folder / LOCK_FILE, follow_symlinks=False)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return os.path.samestat(there, os.fstat(descriptor))


def _holder(descriptor: int) -> str:
    """Who holds a lock; its holder may be about to say so, and what its predecessor said may still stand there."""
    deadline = time.monotonic() + _INTRODUCTION
    while time.monotonic() < deadline:
        with suppress(OSError):
            if (found := _said(descriptor)) is not None:
                return found[0]
        time.sleep(0.02)
    return "another process"


def _said(descriptor: int) -> tuple[str, int] | None:
    """What stands in a lock file, and the process that it names, if that is still there."""
    said = os.pread(descriptor, 200, 0).decode(errors="replace").strip()
    match = re.match(r"process ([1-9]\d{0,8}) on (\S+) since", said)
    return (said, int(match[1])) if match and is_alive(int(match[1]), match[2]) else None

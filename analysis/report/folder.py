"""The results folder holds the earlier results or the new ones, never a part of each."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def new_results(out: Path, replaced: Iterable[str]) -> Iterator[Path]:
    """A folder to write results into, which are moved to ``out`` once all are there; if anything fails, ``out`` stays.

    Files of the same names are replaced. All others stay, for the folder may be a user's, and holds published runs.

    Args:
        out: The results folder, made if need be.
        replaced: Files of earlier results, relative to ``out``, that are removed though they may not be made again.

    Raises:
        OSError: If a file cannot be put into its place, or a folder stands there.
    """
    is_new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    try:
        # Within the folder, and not beside it: it may be a link, or a disk of its own, where files can be moved.
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=out) as scratch:
            new, old = Path(scratch) / "new", Path(scratch) / "old"
            new.mkdir()
            yield new
            _exchange(new, old, out, replaced)
    except BaseException:
        if is_new:
            with suppress(OSError):
                out.rmdir()
        raise


def _exchange(new: Path, old: Path, out: Path, replaced: Iterable[str]) -> None:
    made = sorted(path.relative_to(new) for path in new.rglob("*") if path.is_file())
    moved: list[tuple[Path, Path]] = []
    try:
        for name in dict.fromkeys((*made, *map(Path, replaced))):
            if (out / name).is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(out / name))
            if os.path.lexists(out / name):
                _move(out / name, old / name, moved)
        for name in made:
            _move(new / name, out / name, moved)
    except BaseException:
        for source, target in reversed(moved):
            # The last one was noted and may not have been moved.
            if os.path.lexists(target) and not os.path.lexists(source):
                os.replace(target, source)
        raise


def _move(source: Path, target: Path, moved: list[tuple[Path, Path]]) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    # Noted first, for Ctrl-C may come between the two.
    moved.append((source, target))
    os.replace(source, target)

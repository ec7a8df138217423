"""Which directories below a folder hold a run, and whether a finished one is as it was when it ended.

The one search of the analysis, ``make status`` and ``make publish``. Standard library only, like :mod:`acmr.records`.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import os
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from acmr.foreign import is_there, most_of, opened
from acmr.records import (
    EPISODE_FILES,
    FILES_ENTRY,
    SEAL_ENTRY,
    SEALED_FILES,
    SEED_FOLDER,
    SUMMARY_FILE,
    DamagedError,
)

#: Folders that hold other files of the same names (of W&B, Python); those whose name begins with a dot are, too.
PASSED_OVER = ("wandb", "__pycache__")
#: Folders that are looked into behind one link; no more, should it lead to a whole disk.
_MOST_BEHIND = 20_000
#: Files by which a directory of any name is known to hold a run.
_SIGNS = {*EPISODE_FILES, SUMMARY_FILE}


@dataclass(frozen=True)
class RunFolder:
    """A directory that holds a run.

    Attributes:
        path: Where it lies, below the folder that was searched; by a symbolic link only if there is no other way to it.
        problem: Why it cannot be looked into; empty if it can.
        others: Further ways to the same directory.
    """

    path: Path
    problem: str = ""
    others: tuple[Path, ...] = ()


def run_folders(root: Path) -> list[RunFolder]:
    """Every run below a folder, each once, in the order of their paths.

    A run's directory is called ``seed_<n>`` or holds episodes or a summary; no run is looked for within a ``seed_<n>``.
    Symbolic links are followed, the root's own included. A link that leads nowhere, and a folder that cannot be read,
    are listed with their problem, for there may be runs behind them; so is one that leads to more than
    any folder of runs. A link to a folder that it lies in itself is no way to anything.

    Args:
        root: The folder; may itself be a run's directory.
    """
    search = _Search()
    search.look_into(root)
    # A run goes by its own path rather than by a link's, so that links wait until all else has been seen.
    while search.links:
        links, search.links = sorted(search.links), []
        for link in links:
            search.follow(link)
    return sorted(search.found.values(), key=lambda run: run.path)


def sealed(summary: Mapping[str, Any], files: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """A summary with what :func:`changes` needs to find out whether anything was changed since.

    Args:
        summary: What a finished run says of itself.
        files: ``size`` (bytes) and ``sha256`` (hex) of each of ``SEALED_FILES``.
    """
    content = {**summary, FILES_ENTRY: {name: dict(digest) for name, digest in files.items()}}
    return {**content, SEAL_ENTRY: _seal(content)}


def changes(directory: Path, summary: Mapping[str, Any]) -> dict[str, str]:
    """What of a finished run is not as it was when the run ended: files, and what is said of each.

    Of runs that are older than their digests nothing is known.

    A table that was compressed since, as ``episodes.csv.gz``, is judged by what it holds.

    Args:
        directory: The run's.
        summary: The content of its ``summary.json``.
    """
    if FILES_ENTRY not in summary and SEAL_ENTRY not in summary:
        return {}
    if _seal(summary) != summary.get(SEAL_ENTRY):
        # Of the others nothing is known then.
        return {SUMMARY_FILE: f"{SUMMARY_FILE} was changed since the run ended"}
    files = summary.get(FILES_ENTRY)
    if not isinstance(files, Mapping) or not set(files) <= set(SEALED_FILES):
        return {SUMMARY_FILE: f"{SUMMARY_FILE} names files that are none of a run's"}
    return {name: said for name, digest in files.items() if (said := _change(directory, name, digest))}


class _Search:
    """Goes through folders, each once however many ways lead to it: links in a circle end there."""

    def __init__(self) -> None:
        self.found: dict[Path, RunFolder] = {}
        self.links: list[Path] = []
        self._seen: dict[tuple[int, int], Path] = {}

    def look_into(self, top: Path, most: float = math.inf) -> None:
        """Finds the runs in a folder and below it; links are noted."""
        waiting, looked = [top], 0
        while waiting:
            looked += 1
            if looked > most:
                self.found[top] = RunFolder(
                    top, f"more than {most:,} folders behind this link; not all were looked into"
                )
                return
            folder = waiting.pop()
            try:
                waiting += self._look_at(folder)
            except OSError as error:
                self.found[folder] = RunFolder(folder, f"cannot be read: {error.strerror}")

    def follow(self, link: Path) -> None:
        """Finds the runs that a link leads to, or notes it with those that were found before."""
        try:
            first = self._seen.get(_identity(link))
        except OSError as error:
            target = "it cannot be read"
            with suppress(OSError):
                target = os.readlink(link)
            self.found[link] = RunFolder(link, f"the link leads nowhere: {target} ({error.strerror})")
            return
        if first is None:
            # The root of all disks, a home: it holds the link itself and everything else.
            if not Path(os.path.realpath(link.parent)).is_relative_to(os.path.realpath(link)):
                self.look_into(link, _MOST_BEHIND)
            return
        # A link to a folder that it lies in itself is no way to anything.
        if not link.is_relative_to(first):
            known = [first] if first in self.found else [path for path in self.found if path.is_relative_to(first)]
            for path in known:
                run = self.found[path]
                self.found[path] = replace(run, others=(*run.others, link / path.relative_to(first)))

    def _look_at(self, folder: Path) -> list[Path]:
        """Notes a folder if it holds a run; the folders in it that are to be looked into."""
        identity = _identity(folder)
        if identity in self._seen:
            return []
        self._seen[identity] = folder
        with os.scandir(folder) as listing:
            entries = sorted((entry for entry in listing if not _is_aside(entry.name)), key=lambda entry: entry.name)
        is_seed = SEED_FOLDER.fullmatch(folder.name) is not None
        if is_seed or _SIGNS & {entry.name for entry in entries}:
            self.found[folder] = RunFolder(folder)
        if is_seed:
            return []
        self.links += [Path(entry.path) for entry in entries if entry.is_symlink() and _may_hold_runs(entry)]
        return [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]


def _is_aside(name: str) -> bool:
    return name.startswith(".") or name in PASSED_OVER


def _identity(folder: Path) -> tuple[int, int]:
    status = os.stat(folder)
    return status.st_dev, status.st_ino


def _may_hold_runs(link: os.DirEntry[str]) -> bool:
    """Whether a link leads to a folder, or nowhere: then nobody knows."""
    with suppress(OSError):
        return link.is_dir() or not os.path.exists(link.path)
    return True


def _seal(content: Mapping[str, Any]) -> str:
    rest = {key: value for key, value in content.items() if key != SEAL_ENTRY}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _change(directory: Path, name: str, digest: Any) -> str:
    """What is wrong with a file; empty if nothing is."""
    size, sha256 = (digest.get("size"), digest.get("sha256")) if isinstance(digest, Mapping) else (None, None)
    if not isinstance(size, int) or not isinstance(sha256, str) or size > most_of(name):
        return f"{SUMMARY_FILE} does not say what {name} was"
    path, packed = directory / name, directory / f"{name}.gz"
    is_packed = not is_there(path) and is_there(packed)
    if not is_packed and not is_there(path):
        return f"{name} is missing"
    try:
        with opened(packed if is_packed else path, name) as (stream, length):
            if not is_packed and length != size:
                return f"{name} has {length:,} bytes, not the {size:,} that it had when the run ended"
            if is_packed:
                with gzip.open(stream) as content:
                    same = _sha256(content, size) == sha256
            else:
                same = _sha256(stream, size) == sha256
    except DamagedError as error:
        return str(error)
    except (OSError, EOFError, zlib.error) as error:
        return f"{name} cannot be read ({getattr(error, 'strerror', None) or error})"
    return "" if same else f"{name} was changed since the run ended"


def _sha256(stream: BinaryIO | gzip.GzipFile, size: int) -> str:
    """The hash of a stream; nothing is read that goes beyond its size by more than a block."""
    found, left = hashlib.sha256(), size
    while left >= 0 and (block := stream.read(1 << 20)):
        found.update(block)
        left -= len(block)
    return found.hexdigest()

"""Finished runs -> a folder that can be committed: ``python -m analysis.publish runs/paper results/paper``.

What is left out is large or of no use elsewhere: checkpoints, logs, evaluations, the networks of students. The folder
is analyzed as the runs are, and a teacher in it can be transferred from.
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from acmr.cells import CELLS
from acmr.command import command
from acmr.records import (
    COMPLETE,
    CONFIG_FILE,
    DESCRIPTION_FILE,
    EPISODES_FILE,
    METRICS_FILE,
    SUMMARY_FILE,
    TENSOR_FILE,
    TRANSFER_FILE,
    ended_state,
)
from acmr.run_folders import run_folders
from acmr.text import size

#: A file above this is compressed.
LARGE = 1_000_000
RECORDS = (CONFIG_FILE, SUMMARY_FILE, EPISODES_FILE, METRICS_FILE, TRANSFER_FILE)
TEACHER = (TENSOR_FILE, DESCRIPTION_FILE)


class PublishError(ValueError):
    """Runs that cannot be published. Its message is one line for the user."""


def publish(runs: Path, out: Path) -> tuple[list[Path], list[Path]]:
    """Copies the records of every run that has come to its end, and the networks of those that can teach.

    Args:
        runs: Folder of runs, as ``runs/paper``.
        out: Folder that they are added to, under the same names.

    Returns:
        Run directories below ``out`` that were added, and those that were there already.

    Raises:
        PublishError: If there is nothing to publish, or ``out`` holds other results of a run; then nothing is written.
    """
    folders = [folder.path for folder in run_folders(runs) if (folder.path / SUMMARY_FILE).is_file()]
    found = {path.relative_to(runs): files for path in folders if (files := _files(path))}
    if not found:
        raise PublishError(f"{runs}: no run has come to its end there; make status says how far they are")
    for run, files in found.items():
        differing = [name for name, data in files.items() if _other(out / run / name, data)]
        if differing:
            raise PublishError(
                f"{out / run}: {', '.join(differing)} of another run there; remove that folder or give another one"
            )
    there = [run for run, files in found.items() if all((out / run / name).exists() for name in files)]
    added = [run for run in found if run not in there]
    for run in added:
        (out / run).mkdir(parents=True, exist_ok=True)
        for name, data in found[run].items():
            _write(out / run / name, data)
    return [out / run for run in added], [out / run for run in there]


def _files(run: Path) -> dict[str, bytes]:
    """Names and contents of what is published of a run; nothing if it has not come to its end."""
    try:
        summary = json.loads((run / SUMMARY_FILE).read_text(encoding="utf-8"))
    except ValueError:
        raise PublishError(f"{run / SUMMARY_FILE}: cannot be read; move that run away, or make it anew") from None
    if ended_state(summary) is None:
        return {}
    names = (*RECORDS, *(TEACHER if _teaches(summary) else ()))
    return dict(_packed(run / name) for name in names if (run / name).is_file())


def _teaches(summary: dict[str, Any]) -> bool:
    cell = CELLS.get(str(summary.get("cell")))
    return cell is not None and cell.teaches and ended_state(summary) == COMPLETE


def _packed(path: Path) -> tuple[str, bytes]:
    data = path.read_bytes()
    if path.suffix != ".csv" or len(data) <= LARGE:
        return path.name, data
    return f"{path.name}.gz", gzip.compress(data, mtime=0)


def _other(path: Path, data: bytes) -> bool:
    return path.exists() and path.read_bytes() != data


def _write(path: Path, data: bytes) -> None:
    unfinished = path.with_name(f".{path.name}.tmp")
    unfinished.write_bytes(data)
    os.replace(unfinished, path)


def _report(added: list[Path], there: list[Path]) -> Iterator[str]:
    for run in added:
        yield f"added    {run} ({size(sum(path.stat().st_size for path in run.iterdir()))})"
    for run in there:
        yield f"is there {run}"


@command
def main() -> int:
    """Entry of ``python -m analysis.publish``."""
    parser = argparse.ArgumentParser(prog="python -m analysis.publish", description="Finished runs, to be committed.")
    parser.add_argument("runs", type=Path, help="folder of runs, as runs/paper")
    parser.add_argument("out", type=Path, help="where they are added, as results/paper")
    arguments = parser.parse_args()
    try:
        print("\n".join(_report(*publish(arguments.runs, arguments.out))))
    except (OSError, ValueError) as error:
        print(f"analysis.publish: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

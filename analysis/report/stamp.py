"""Whether results are still those of the runs they were made from."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from acmr import cells
from acmr.foreign import is_there, read_bytes
from acmr.records import STATUS_FILE, DamagedError
from analysis.loading.load import RunSet
from analysis.report.html import RUN_FILES

#: File in the results folder that holds the fingerprint of what they were made from.
STAMP = "inputs.sha256"


def fingerprint(data: RunSet, out: Path, settings: dict[str, object]) -> str:
    """Hash of all that the results follow from: contents of the runs, the analysis, the cells, the settings.

    Args:
        data: The runs.
        out: Folder of the results, for links in them depend on where it lies.
        settings: Options of the command line.
    """
    digest = hashlib.sha256(repr(sorted(settings.items())).encode())
    digest.update(os.fsencode(os.path.relpath(data.root.resolve(), out.resolve())))
    package, ground = Path(__file__).parent.parent, Path(cells.__file__).parent
    sources = sorted(path for path in package.rglob("*") if path.suffix in (".py", ".html", ".css", ".js", ".csv"))
    runs = [data.root / str(run) / name for run in data.runs["directory"] for name in (*RUN_FILES, STATUS_FILE)]
    places = {package: sources, ground: sorted(ground.glob("*.py")), data.root: runs}
    for base, path in [(base, path) for base, paths in places.items() for path in paths]:
        if is_there(path):
            try:
                content = hashlib.sha256(read_bytes(path)).hexdigest()
            except DamagedError as error:
                content = str(error)
            digest.update(os.fsencode(f"{path.relative_to(base).as_posix()} {content}\n"))
    return digest.hexdigest()


def is_current(out: Path, value: str) -> bool:
    """Whether the folder holds results with this fingerprint."""
    stamp = out / STAMP
    return (out / "report.html").is_file() and stamp.is_file() and stamp.read_text(encoding="utf-8").strip() == value

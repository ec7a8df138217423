"""Writes the tables and figures of ``docs/shifts.md`` from committed files: ``python -m docs.shifts``.

``python -m docs.shifts runs/shifts --look FOLDER`` writes those of runs that are not published yet into a folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from analysis.figures.paper import save
from analysis.figures.style import apply
from docs.shifts.figures import figures
from docs.shifts.runs import PUBLISHED, ROOT, read
from docs.shifts.tables import PAGE, filled, tables

IMAGES = ROOT / "docs" / "images" / "shifts"


def main() -> None:
    """Fills the page and draws its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="?", default=PUBLISHED, help="folder of the runs (results/shifts)")
    parser.add_argument("--look", type=Path, metavar="FOLDER", help="write into this folder, and leave the page alone")
    given = parser.parse_args()
    found = read(given.runs)
    apply()
    out = given.look or IMAGES
    out.mkdir(parents=True, exist_ok=True)
    for name, figure in figures(found):
        save(figure, out, name, ("png",))
    if given.look:
        text = "\n\n".join(f"## {name}\n\n{text}" for name, text in tables(found).items())
        (out / "shifts.md").write_text(f"{text}\n", encoding="utf-8")
    else:
        PAGE.write_text(filled(found), encoding="utf-8")


if __name__ == "__main__":
    main()

"""The report: one HTML file that needs nothing else, not even a network."""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

from acmr.records import CONFIG_FILE, LOG_FILE, SUMMARY_FILE
from analysis.loading.episodes import EPISODE_FILES
from analysis.loading.load import RunSet
from analysis.loading.missing import Missing
from analysis.loading.speed import METRICS_FILES
from analysis.report.published import published_table3
from analysis.report.tables import heading, readable

#: Files of a run that are linked where they are there.
RUN_FILES = (*EPISODE_FILES, *METRICS_FILES, CONFIG_FILE, SUMMARY_FILE, LOG_FILE)


@dataclass(frozen=True)
class Picture:
    """A figure in the report.

    Attributes:
        name: File name without its ending; also its anchor.
        title: Heading.
        caption: What it shows.
        images: Data URI by palette; a rendered picture has only one.
        files: Names of the files written for it, relative to the report.
    """

    name: str
    title: str
    caption: str
    images: dict[str, str]
    files: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Table:
    """A table in the report: text by row, with the plain values for sorting."""

    columns: list[str]
    rows: list[list[str]]
    numeric: list[bool]


@dataclass(frozen=True)
class Report:
    """Everything the report shows."""

    data: RunSet
    profile: str
    threshold: float
    consecutive: int
    cells: pd.DataFrame
    table1: pd.DataFrame
    table2: pd.DataFrame
    table3: pd.DataFrame
    groups: pd.DataFrame
    published: pd.DataFrame
    transfer: pd.DataFrame
    measured: pd.DataFrame
    defining: pd.DataFrame
    differing: pd.DataFrame
    pictures: list[Picture]
    missing: list[Missing]
    matrix_command: str
    planned_runs: int
    left_out: list[str]
    about_n: list[str]
    caveats: list[str]
    how_runs_count: list[str]


def data_uri(content: bytes, kind: str) -> str:
    """A picture as the address of an image: ``kind`` is ``svg+xml`` or ``png``."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def write_report(report: Report, out: Path) -> Path:
    """Writes ``report.html``.

    Args:
        report: What it shows.
        out: Folder of the results; links to runs and tables are relative to it.

    Returns:
        Its path.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("analysis.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["words"] = heading
    page = environment.get_template("report.html").render(
        report=report,
        table=_table,
        runs=_runs(report, out),
        source=published_table3()["source"].iloc[0],
        detailed=_detailed(report.table3),
        notes=_notes,
    )
    path = out / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _table(frame: pd.DataFrame, columns: Sequence[str] | None = None) -> Table:
    shown = frame if columns is None else frame[list(columns)]
    text = readable(shown, missing="–")
    numeric = [bool(pd.api.types.is_numeric_dtype(shown[name])) for name in shown.columns]
    return Table([str(name) for name in shown.columns], text.to_numpy().tolist(), numeric)


def _detailed(table3: pd.DataFrame) -> Table:
    """Table 3 turned on its side: a column for each comparison, for it has too many numbers to lie."""
    text = readable(table3, missing="–")
    heads = [f"{index} − {reference}" for index, reference in zip(text["index"], text["reference"], strict=True)]
    names = [name for name in text.columns if name not in ("reference", "index", "note")]
    rows = [[heading(name), *text[name]] for name in names]
    return Table(["", *heads], rows, [False] + [True] * len(heads))


def _notes(comparisons: pd.DataFrame) -> list[str]:
    """Each note once, though a cell has it in every comparison."""
    return list(dict.fromkeys(note for row in comparisons["note"] for note in row.split("; ") if note))


def _runs(report: Report, out: Path) -> list[dict[str, Any]]:
    rows = []
    for name, run in report.measured.iterrows():
        directory = report.data.root / str(name)
        links = [(file, _relative(directory / file, out)) for file in RUN_FILES if (directory / file).is_file()]
        rows.append(
            {
                "run": str(name),
                "link": _relative(directory, out),
                "files": links,
                "group": run["group"],
                "seed": None if pd.isna(run["seed"]) else int(run["seed"]),
                "state": run["state"],
                "reason": run["reason"],
                "steps": _known(run["steps_to_threshold"]),
                "first": _known(run["steps_to_threshold_first"]),
                "last_step": int(run["last_step"]),
                "episodes": int(run["episodes"]),
                "final": _known(run["asymptotic_return"]),
                "minutes": _known(run["wall_seconds"] / 60),
                "speed": _known(run["steps_per_second"]),
            }
        )
    return rows


def _known(value: float) -> float | None:
    return None if pd.isna(value) else float(value)


def _relative(path: Path, out: Path) -> str:
    return Path(os.path.relpath(path.resolve(), out.resolve())).as_posix()

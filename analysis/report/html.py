"""The report: one HTML file that needs nothing else, not even a network."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from markupsafe import Markup

from acmr.foreign import is_file, real_path
from acmr.names import link, terminal
from acmr.records import CONFIG_FILE, EPISODE_FILES, LOG_FILE, SUMMARY_FILE
from analysis.analyze import Analysis
from analysis.loading.missing import matrix_command, profile_of
from analysis.loading.setting_differences import setting_differences
from analysis.loading.speed import METRICS_FILES
from analysis.report import prose, study
from analysis.report.published import published_table3
from analysis.report.tables import footnote, heading, marked, readable

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
    """Everything the report shows.

    Attributes:
        analysis: The numbers.
        tables: The tables that are written, by file name.
        pictures: The figures, in the order in which they are shown.
        left_out: A line for what could not be made.
    """

    analysis: Analysis
    tables: Mapping[str, pd.DataFrame]
    pictures: list[Picture]
    left_out: list[str]


def data_uri(content: bytes, kind: str) -> str:
    """A picture as the address of an image: ``kind`` is ``svg+xml`` or ``png``."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def write_report(report: Report, folder: Path, out: Path) -> Path:
    """Writes ``report.html``.

    Args:
        report: What it shows.
        folder: Where it is written.
        out: Where it will lie; links to runs and tables are relative to that.

    Returns:
        Its path.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("analysis.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        # Whatever the page shows goes through here, then through the escaping of HTML.
        finalize=_shown,
    )
    environment.filters["footnote"] = footnote
    numbers = report.analysis
    defining, differing = setting_differences(numbers.data)
    style, script = (_source(environment, name) for name in ("report.css", "report.js"))
    page = environment.get_template("report.html").render(
        style=style,
        script=script,
        # Only what stands here word for word is run or applied: nothing that a name brings along.
        allowed={"style": _hash(style), "script": _hash(script)},
        report=report,
        analysis=numbers,
        profile=profile_of(numbers.data),
        matrix_command=matrix_command(numbers.data),
        table=_table,
        runs=_runs(numbers, out),
        source=published_table3()["source"].iloc[0],
        detailed=_detailed(numbers.table3),
        notes=_notes,
        study_words=study,
        defining=_table(defining, head=str),
        differing=_table(differing, head=str),
        about_n=prose.about_n(numbers.table3, numbers.data.cells),
        caveats=prose.caveats(numbers.threshold, numbers.data.cells),
        how_runs_count=prose.how_runs_count(numbers.consecutive),
    )
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _source(environment: jinja2.Environment, name: str) -> Markup:
    """A file of ours that becomes a part of the page as it is."""
    assert environment.loader is not None
    return Markup(environment.loader.get_source(environment, name)[0])


def _hash(text: str) -> str:
    """What a content security policy calls the text of an element."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}"


def _shown(value: object) -> object:
    return terminal(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _table(frame: pd.DataFrame, columns: Sequence[str] | None = None, head: Callable[[str], str] = heading) -> Table:
    shown = marked(frame) if columns is None else marked(frame)[list(columns)]
    text = readable(shown, missing="–")
    kinds = (frame if columns is None else frame[list(columns)]).dtypes
    # By place, for groups may have one name with another column.
    numeric = [bool(pd.api.types.is_numeric_dtype(kind)) for kind in kinds]
    return Table([head(str(name)) for name in shown.columns], text.to_numpy().tolist(), numeric)


def _detailed(table3: pd.DataFrame) -> Table:
    """Table 3 turned on its side: a column for each comparison, for it has too many numbers to lie."""
    text = readable(marked(table3), missing="–")
    heads = [f"{index} − {reference}" for index, reference in zip(text["index"], text["reference"], strict=True)]
    names = [name for name in text.columns if name not in ("reference", "index", "note")]
    rows = [[heading(name), *text[name]] for name in names]
    return Table(["", *heads], rows, [False] + [True] * len(heads))


def _notes(comparisons: pd.DataFrame) -> list[str]:
    """Each note once, though a cell has it in every comparison."""
    return list(dict.fromkeys(note for row in comparisons["note"] for note in row.split("; ") if note))


def _runs(analysis: Analysis, out: Path) -> list[dict[str, Any]]:
    rows = []
    for name, run in analysis.measured.iterrows():
        directory = analysis.data.root / run["directory"]
        links = [(file, _relative(directory / file, out)) for file in RUN_FILES if is_file(directory / file)]
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
    # Else a folder that is called "javascript:..." or "https:..." would be another kind of address.
    return f"./{link(Path(os.path.relpath(real_path(path), real_path(out))))}"

"""Writes everything into the results folder: tables, scores, figures, report."""

from __future__ import annotations

import argparse
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from acmr.names import archive_keys
from analysis import FORMATS
from analysis.analyze import Analysis
from analysis.figures import stills
from analysis.figures.data import FigureData, default_window, learning_curves, training_speeds
from analysis.figures.paper import FIGURES, draw_all, picture, save
from analysis.figures.style import apply
from analysis.report.html import Picture, Report, data_uri, write_report
from analysis.report.published import side_by_side
from analysis.report.study import PAIRED_COLUMNS
from analysis.report.tables import STEPS_COLUMNS, paper_columns, write_table
from analysis.statistics.summaries import scores, steps_table, table1, table2, transfer_table

_STILLS = {"figure_2": ("Figure 2", "The source environment"), "figure_3": ("Figure 3", "The target environment")}


@dataclass
class Written:
    """What was written.

    Attributes:
        tables: Number of tables (each in three formats).
        figures: Number of figures (each in two palettes).
        left_out: A line for what could not be made.
    """

    tables: int = 0
    figures: int = 0
    left_out: list[str] = field(default_factory=list)


#: Files of an earlier analysis that go although this one may not make them again. Figures 2 and 3 are not among them:
#: a machine without a GL library shall not take them away.
REPLACED = (
    *(f"{folder}{spec.name}.{kind}" for folder in ("", "colorblind/") for spec in FIGURES for kind in FORMATS),
    *(f"comparisons.{kind}" for kind in ("csv", "md", "tex")),
)


def write_results(analysis: Analysis, folder: Path, out: Path, options: argparse.Namespace, scratch: Path) -> Written:
    """Writes all results.

    Args:
        analysis: The numbers.
        folder: An empty folder, for the results.
        out: Where they will lie; links in them are relative to it.
        options: ``format``, ``window`` and ``no_stills`` of the command line.
        scratch: Folder for files that are not kept.
    """
    (folder / "colorblind").mkdir()
    written = Written()
    # The pictures take seconds, in processes of their own: they are made while the rest is.
    rendering = [] if options.no_stills else stills.start(analysis.data.pair, scratch)
    try:
        tables = _write_tables(analysis, folder, written)
        pictures = _write_figures(analysis, folder, options, written)
        pictures = _write_stills(rendering, folder, options.format, written) + pictures
    finally:
        stills.stop(rendering)
    write_report(Report(analysis, tables, pictures, written.left_out), folder, out)
    return written


def _write_tables(analysis: Analysis, out: Path, written: Written) -> dict[str, pd.DataFrame]:
    data, measured, study = analysis.data, analysis.measured, analysis.study
    plan = {
        "table1": (table1(), "Overview of ACMR configurations.", None),
        "table2": (table2(data), "Experiment overview.", None),
        "table3": (analysis.table3, "Statistical comparison of steps to threshold.", paper_columns(analysis.table3)),
        "published_table3": (side_by_side(analysis.table3), "Table 3 beside the published one.", None),
        "transfer": (transfer_table(measured, data.groups, analysis.reference), "Transfer metrics.", None),
        "sensitivity": (study.sensitivity, "Differences by threshold and criterion.", None),
        "sensitivity_points": (study.points, "Differences by threshold and criterion, every number.", None),
        "sensitivity_overview": (study.overview, "How far differences hang on threshold and criterion.", None),
        "paired": (study.paired, "Comparisons by seed.", PAIRED_COLUMNS),
        "blocks": (study.blocks, "All cells of a family, seeds being blocks.", None),
        "equivalence": (study.equivalence, "Two one-sided tests for equivalence.", None),
        "aggregates": (study.aggregates, "Interquartile means.", None),
        "improvement": (study.improvement, "Probability of improvement.", None),
        "cost": (study.cost, "Steps with those of the teacher, and without.", None),
        "cells": (analysis.cells, "Steps to threshold by group.", None),
        "steps_to_threshold": (steps_table(measured), "Steps to threshold of each run.", STEPS_COLUMNS),
    }
    if len(analysis.others):
        plan["comparisons"] = (analysis.others, "Groups that are no cells.", paper_columns(analysis.others))
    for name, (table, caption, columns) in plan.items():
        write_table(table, out, name, caption, columns)
    _write_arrays(scores(measured), out / "scores.npz")
    written.tables = len(plan)
    return {name: table for name, (table, _, _) in plan.items()}


def _write_arrays(arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Arrays by name, as ``numpy.load`` reads them; ``numpy.savez`` takes some names for arguments of its own."""
    keys = archive_keys(arrays)
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{keys[name]}.npy", "w") as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def figure_data(analysis: Analysis, window: int | None = None) -> FigureData:
    """What the figures draw.

    Args:
        analysis: The numbers.
        window: Episodes of the rolling average; None: the paper's, fewer for short runs.
    """
    measured, data = analysis.measured, analysis.data
    window = window or default_window(measured, data.episodes)
    return FigureData(
        runs=measured,
        episodes=data.episodes,
        groups=data.groups,
        comparisons=analysis.comparisons,
        threshold=analysis.threshold,
        window=window,
        planned=analysis.planned,
        curves=learning_curves(measured, data.episodes, data.groups, window),
        speeds=training_speeds(data.root, measured, data.groups),
        sensitivity=analysis.study.points,
    )


def _write_figures(analysis: Analysis, out: Path, options: argparse.Namespace, written: Written) -> list[Picture]:
    apply()
    drawing = figure_data(analysis, options.window)
    made: dict[str, Picture] = {}
    for spec, palette, figure in draw_all(drawing):
        folder = "" if palette.name == "paper" else palette.name
        svg = save(figure, out / folder, spec.name, options.format)
        files = [f"{spec.name}.{kind}" for kind in options.format]
        entry = made.setdefault(spec.name, Picture(spec.name, spec.title, spec.said(drawing), {}, files))
        entry.images[palette.name] = data_uri(svg, "svg+xml")
    written.figures += len(made)
    return list(made.values())


def _write_stills(
    rendering: list[stills.Still], out: Path, formats: tuple[str, ...], written: Written
) -> list[Picture]:
    made = []
    for still in rendering:
        image, problem = stills.finish(still)
        title, caption = _STILLS[still.name]
        if image is None:
            line = f"figures 2 and 3 left out: {problem}"
            written.left_out += [line] if line not in written.left_out else []
            continue
        save(picture(image), out, still.name, formats)
        files = [f"{still.name}.{kind}" for kind in formats]
        address = data_uri(still.path.read_bytes(), "png")
        made.append(Picture(still.name, title, f"{caption}: {still.env}.", {"paper": address}, files))
    written.figures += len(made)
    return made

"""All steps in a row: runs -> metrics -> comparisons -> tables and figures -> report."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from acmr.names import terminal
from analysis.analyze import Analysis, analyze
from analysis.loading.load import load
from analysis.loading.missing import matrix_command, missing_runs, planned_runs, profile_of
from analysis.report.study import study_lines
from analysis.report.terminal import left_out_lines, missing_lines, print_summary, result_lines


def run(options: argparse.Namespace) -> int:
    """What the command line asks for; see :func:`analysis.cli.main`."""
    data = load(options.runs)
    missing, planned = missing_runs(data), planned_runs(data)
    lines = missing_lines(missing, planned, matrix_command(data))
    if not len(data.episodes):
        said = [f"{options.runs}: no run with episodes to analyze", *left_out_lines(data.runs), *lines]
        print("\n".join(map(terminal, said)), file=sys.stderr)
        return 1
    analysis = analyze(data, options.threshold, options.consecutive, options.reference, options.margin)
    closing = [] if options.summary else _write(analysis, options)
    title = f"Steps to threshold {analysis.threshold:g} ({analysis.consecutive} episodes in a row), {profile_of(data)}"
    print_summary(analysis.cells, analysis.comparisons, title)
    if options.summary:
        print_study(analysis)
    notes = [*dict.fromkeys(filter(None, analysis.measured["bias"])), *analysis.doubts]
    print("\n".join(map(terminal, ["", *notes, *left_out_lines(analysis.measured), *lines, *closing])))
    return 0


def print_study(analysis: Analysis) -> None:
    """Prints what stands beyond table 3."""
    for title, lines in study_lines(analysis.study).items():
        print("\n".join(map(terminal, ["", title, *(f"  {line}" for line in lines)])))


def _write(analysis: Analysis, options: argparse.Namespace) -> list[str]:
    """Writes the results, unless they are there; what to say of them."""
    from analysis.report.stamp import STAMP, fingerprint, is_current

    out: Path = options.out or Path("results") / options.runs.resolve().name
    asked = {key: value for key, value in vars(options).items() if key not in ("runs", "out", "if_changed")}
    value = fingerprint(analysis.data, out, asked)
    if options.if_changed and is_current(out, value):
        return [f"results: {out}/ (nothing has changed since they were written)", f"report:  {out / 'report.html'}"]
    from analysis.report.folder import new_results
    from analysis.report.write import REPLACED, write_results

    with tempfile.TemporaryDirectory() as scratch, new_results(out, REPLACED) as folder:
        written = write_results(analysis, folder, out, options, Path(scratch))
        (folder / STAMP).write_text(value + "\n", encoding="utf-8")
    return [*written.left_out, *result_lines(out, written.tables, written.figures)]

"""From run directories to the paper: steps to threshold, statistics, tables, figures, a report.

``python -m analysis RUNS --out OUT`` is the whole of it (:mod:`analysis.cli`). The way of a number:
:mod:`analysis.loading.load` -> :mod:`analysis.statistics.metrics` -> :mod:`analysis.statistics.comparisons` ->
:mod:`analysis.report.tables`.
"""

#: File formats of the figures.
FORMATS = ("pdf", "png", "svg")

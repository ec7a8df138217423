"""From run directories to the paper: steps to threshold, statistics, tables, figures, a report.

``python -m analysis RUNS --out OUT`` is the whole of it (:mod:`analysis.cli`). The way of a number is
:mod:`analysis.load` -> :mod:`analysis.metrics` -> :mod:`analysis.comparisons` -> :mod:`analysis.tables`.
"""

#: File formats of the figures.
FORMATS = ("pdf", "png", "svg")

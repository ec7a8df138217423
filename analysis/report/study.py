"""The study beyond table 3 in words, for the terminal and the report."""

from __future__ import annotations

import pandas as pd

#: What is said of the sensitivity of all comparisons.
SENSITIVITY = (
    "Index less reference, in steps: below 0 the index is faster. In brackets: restricted means, for some run never "
    "met the criterion. Empty: some run stopped at its own threshold before it met the criterion, or none met it; "
    "criteria of which nothing is known are left out. Rows of full runs are of those alone that took all their steps. "
    "One threshold and one criterion were chosen before the runs; the others show how far the answer hangs on that "
    "choice, and are no tests."
)


def sensitivity_lines(overview: pd.DataFrame) -> list[str]:
    """A line for each comparison: at how many thresholds and criteria the index is ahead, and by how much.

    Args:
        overview: :func:`analysis.statistics.study.sensitivity.overview`.
    """
    lines = []
    for row in overview.to_dict("records"):
        name = (
            f"{row['index']} − {row['reference']}, {row['basis']} runs ({row['runs_index']} + {row['runs_reference']})"
        )
        if not row["known"]:
            lines.append(f"{name}: not known at any of {row['settings']} settings")
            continue
        lines.append(
            f"{name}: index faster at {row['faster']} of {row['known']} settings known of {row['settings']}; "
            f"from {steps(row['lowest'])} to {steps(row['highest'])}, as asked {steps(row['asked'])}"
        )
    return lines


def steps(value: float) -> str:
    """A difference in steps with its sign; a dash if it is not known."""
    return "–" if pd.isna(value) else f"{value:,.0f}".replace("-", "−")

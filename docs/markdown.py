"""What the tables of these pages are printed with."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def duration(seconds: float) -> str:
    """Hours and minutes."""
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def steps(value: float) -> str:
    """Whole steps, or a dash for NaN."""
    return "–" if pd.isna(value) else f"{value:,.0f}".replace("-", "−")


def number(value: float, digits: int) -> str:
    """So many decimals, or a dash for NaN."""
    return "–" if pd.isna(value) else f"{value:.{digits}f}".replace("-", "−")


def p_value(value: float) -> str:
    """Three decimals, or a dash for NaN."""
    if pd.isna(value):
        return "–"
    return f"{value:.3f}" if value >= 0.0005 else "< 0.001"


def span(value: float, low: float, high: float) -> str:
    """A number of steps with its interval, as far as there is one."""
    return steps(value) if pd.isna(low) else f"{steps(value)} ({steps(low)} to {steps(high)})"

"""What the tables of these pages are printed with."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

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


def span(row: Mapping[Hashable, Any], name: str) -> str:
    """A number of steps with its interval, as ``difference`` with ``difference_low`` and ``difference_high``."""
    low, high = steps(row[f"{name}_low"]), steps(row[f"{name}_high"])
    return f"{steps(row[name])} ({low} to {high})" if low != "–" else steps(row[name])

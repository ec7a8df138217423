"""How fast each run learned, step by step, from its ``metrics.csv``."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd

from acmr.foreign import is_there, read_bytes, unpack
from acmr.records import METRIC_COLUMNS, METRICS_FILE, DamagedError

#: What a run's metrics may lie in; the first that is there is read.
METRICS_FILES = (METRICS_FILE, f"{METRICS_FILE}.gz")
#: Points that a run's curve has at most.
POINTS = 250


def read_speed(directory: Path, start: float = 0.0) -> pd.DataFrame:
    """Environment steps per second of one run, over its steps.

    Args:
        directory: The run's. A file that is not there or cannot be read is an empty frame: nothing else rests on it.
        start: Steps up to here are left out; without learning they are some thirty times as fast.

    Returns:
        ``step`` (the last of those that the speed is of) and ``steps_per_second``, at most ``POINTS`` rows: medians
        of as many rows of the file as that takes.
    """
    path = next((directory / name for name in METRICS_FILES if is_there(directory / name)), None)
    empty = pd.DataFrame({"step": [], "steps_per_second": []}, dtype=float)
    if path is None:
        return empty
    try:
        data = read_bytes(path)
        content = io.BytesIO(unpack(data, path.name) if path.suffix == ".gz" else data)
        table = pd.read_csv(content, usecols=list(METRIC_COLUMNS), on_bad_lines="skip")
        table = table.apply(pd.to_numeric, errors="coerce").dropna().astype(float)
    except (DamagedError, ValueError):
        return empty
    table = table[(table["global_step"] > start) & np.isfinite(table["steps_per_second"])]
    bins = np.arange(len(table)) // max(1, -(-len(table) // POINTS))
    grouped = table.groupby(bins)
    return pd.DataFrame(
        {"step": grouped["global_step"].last(), "steps_per_second": grouped["steps_per_second"].median()}
    ).astype(float)

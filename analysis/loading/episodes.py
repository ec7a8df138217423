"""One file of episodes -> one frame, or the reason why not."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from acmr.records import EPISODE_COLUMNS, VELOCITY_COLUMN, DamagedError


def read_episodes(path: Path) -> tuple[pd.DataFrame, list[str]]:
    """Reads the episodes of one run.

    The last line is left out if it does not end (the run was cut off in the middle of writing it). Returns that are
    no finite number become NaN, which meets no threshold.

    Args:
        path: ``episodes.csv`` or ``episodes.csv.gz``; columns beyond the known ones are passed over.

    Returns:
        The frame: ``global_step`` (int64, strictly ascending), ``episodic_return``, ``episode_length`` (steps, int64),
        ``mean_forward_velocity`` (m/s, NaN where it was not recorded); and what there is to say about the file.

    Raises:
        DamagedError: If the columns are not there, a line cannot be read, or the rows are not in order.
    """
    header, _, body = _contents(path).partition(b"\n")
    columns = header.decode("utf-8-sig", errors="replace").strip().split(",")
    missing = [name for name in EPISODE_COLUMNS if name not in columns]
    if missing:
        raise DamagedError(f"{path.name}: no column {', '.join(missing)} (needed: {','.join(EPISODE_COLUMNS)})")
    notes = []
    body, cut = _whole_lines(body)
    if cut:
        line = body.count(b"\n") + 2
        notes.append(f"cut off in line {line}, which is left out")
    frame, said = _parse(path.name, columns, body)
    notes += said
    _check_order(path.name, frame)
    returns = frame["episodic_return"].to_numpy()
    odd = ~np.isfinite(returns)
    if odd.any():
        frame["episodic_return"] = np.where(odd, np.nan, returns)
        notes.append(f"{int(odd.sum())} returns are no finite number")
    return frame, notes


def _contents(path: Path) -> bytes:
    try:
        if path.suffix == ".gz":
            with gzip.open(path) as file:
                return file.read()
        return path.read_bytes()
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DamagedError(f"{path.name}: cannot be decompressed ({error})") from None
    except OSError as error:
        raise DamagedError(f"{path.name}: {error.strerror or error}") from None


def _whole_lines(body: bytes) -> tuple[bytes, bool]:
    end = body.rfind(b"\n") + 1
    whole = body[:end].rstrip(b"\r\n")
    return (whole + b"\n" if whole else b""), bool(body[end:].strip())


def _parse(name: str, columns: list[str], body: bytes) -> tuple[pd.DataFrame, list[str]]:
    # A line that is too short would go unnoticed if only columns after the first ones are missing.
    if body.count(b",") != body.count(b"\n") * (len(columns) - 1):
        raise _first_fault(name, columns, body)
    notes: list[str] = []
    numbers = _numbers(body, columns, (*EPISODE_COLUMNS, VELOCITY_COLUMN))
    if numbers is None:
        numbers = _numbers(body, columns, EPISODE_COLUMNS)
        if VELOCITY_COLUMN in columns:
            notes.append(f"{VELOCITY_COLUMN} is left out, for it holds more than numbers")
    if numbers is None:
        raise _first_fault(name, columns, body)
    for column in ("global_step", "episode_length"):
        values = numbers[column]
        whole = np.isfinite(values) & (values == np.floor(values)) & (values > 0) & (values < 2.0**53)
        if not whole.all():
            row = int(np.argmin(whole))
            raise DamagedError(f"{name}: line {row + 2}: {column} is {values[row]:g}, not a count of steps")
        numbers[column] = values.astype(np.int64)
    numbers.setdefault(VELOCITY_COLUMN, np.full(len(numbers["global_step"]), np.nan))
    return pd.DataFrame(numbers), notes


def _numbers(body: bytes, columns: list[str], wanted: tuple[str, ...]) -> dict[str, NDArray[Any]] | None:
    """Columns of a table without header, each number read to its last bit; None if one holds anything else."""
    there = [column for column in wanted if column in columns]
    if not body:
        return {column: np.empty(0) for column in there}
    positions = [columns.index(column) for column in there]
    try:
        table = np.loadtxt(io.BytesIO(body), delimiter=",", usecols=positions, comments=None, ndmin=2)
    except ValueError:
        return None
    return dict(zip(there, np.ascontiguousarray(table.T), strict=True))


def _first_fault(name: str, columns: list[str], body: bytes) -> DamagedError:
    for number, line in enumerate(body.decode("utf-8", errors="replace").splitlines(), start=2):
        values = line.split(",")
        if len(values) != len(columns):
            return DamagedError(f"{name}: line {number} holds {len(values)} values, not {len(columns)}")
        for column, value in zip(columns, values, strict=True):
            if column in EPISODE_COLUMNS and not _is_number(value):
                return DamagedError(f"{name}: line {number}: {column} is {value[:20]!r}, not a number")
    return DamagedError(f"{name}: cannot be read as a table of numbers")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check_order(name: str, frame: pd.DataFrame) -> None:
    steps = frame["global_step"].to_numpy()
    ahead = np.diff(steps) > 0
    if not ahead.all():
        row = int(np.argmin(ahead))
        raise DamagedError(
            f"{name}: rows are not in order: line {row + 3} is at step {steps[row + 1]}, the one before at {steps[row]}"
        )

"""One file of episodes -> one frame, or the reason why not."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from acmr.foreign import read_bytes, unpack
from acmr.records import EPISODE_COLUMNS, VELOCITY_COLUMN, DamagedError
from analysis.loading.csv_table import Table, check_signs, read_table, to_numbers

_KNOWN = (*EPISODE_COLUMNS, VELOCITY_COLUMN)
_COUNTS = ("global_step", "episode_length")
#: Sums and squares of larger returns may be no number any more.
_MOST_RETURN = 1e100
#: A header as our runs write it.
_PLAIN_HEADER = re.compile(rb"\w+(,\w+)*\r?")

_Numbers = dict[str, NDArray[Any]]


def read_episodes(path: Path, own: bool = False, ended: bool = False) -> tuple[pd.DataFrame, list[str]]:
    """Reads the episodes of one run.

    Returns that are no finite number become NaN, which meets no threshold. Of a last line that does not end nobody
    knows whether its last number is whole: a run of ours that has not ended was cut off in the middle of writing it,
    and it is left out. Other programs, and editors, end files so: there it counts if all its values are there.

    Args:
        path: ``episodes.csv`` or ``episodes.csv.gz`` (:func:`~analysis.loading.csv_table.read_table` says what may
            stand in it); columns beyond the known ones are passed over.
        own: Whether it is a run of this project's. It takes one step at a time, so that no two of its episodes end at
            the same one; those of environments that step together may.
        ended: Whether the run came to its end.

    Returns:
        The frame: ``global_step`` (int64, ascending), ``episodic_return``, ``episode_length`` (steps, int64),
        ``mean_forward_velocity`` (m/s, NaN where it was not recorded); and what there is to say about the file.

    Raises:
        DamagedError: If the columns are not there, a line cannot be read, or the rows are not in order.
    """
    content, notes = _contents(path), list[str]()
    if own and not ended:
        content, notes = _whole_lines(content)
    numbers, lines, said = _read_plain(content) or _read_any(path.name, content)
    notes += said
    for column in _COUNTS:
        numbers[column] = _to_counts(path.name, column, numbers[column], lines)
    numbers.setdefault(VELOCITY_COLUMN, np.full(len(lines), np.nan))
    frame = pd.DataFrame({column: numbers[column] for column in _KNOWN})
    _check_order(path.name, frame, lines, own)
    if own:
        notes += _odd_lengths(path.name, frame, lines)
    returns = frame["episodic_return"].to_numpy()
    # Of the comparisons with NaN none is true.
    odd = ~(np.abs(returns) < _MOST_RETURN)
    if odd.any():
        frame["episodic_return"] = np.where(odd, np.nan, returns)
        notes.append(f"{int(odd.sum())} returns are no finite number below {_MOST_RETURN:g}")
    return frame, notes


def _contents(path: Path) -> bytes:
    data = read_bytes(path, title=path.name)
    return unpack(data, path.name) if path.suffix == ".gz" else data


def _whole_lines(content: bytes) -> tuple[bytes, list[str]]:
    """The lines that end, and a note if the last one does not; a header alone need not."""
    end = content.rfind(b"\n") + 1
    if not end or not content[end:].strip():
        return content, []
    return content[:end], [_cut_off(content.count(b"\n") + 1)]


def _cut_off(line: int) -> str:
    return f"cut off in line {line}, which is left out"


def _read_plain(content: bytes) -> tuple[_Numbers, NDArray[np.int64], list[str]] | None:
    """Columns and lines of a file as our runs write it, read to the last bit and quickly; None: it is none."""
    header, _, body = content.partition(b"\n")
    if not _PLAIN_HEADER.fullmatch(header) or (body and not body.endswith(b"\n")):
        return None
    columns = header.decode().strip().split(",")
    there = [column for column in _KNOWN if column in columns]
    first = body.partition(b"\n")[0].decode(errors="replace").split(",")
    # A count with a point may be thousands.
    pointed = any("." in value for column, value in zip(columns, first, strict=False) if column in _COUNTS)
    whole = body.count(b",") == body.count(b"\n") * (len(columns) - 1)
    if pointed or not whole or len({*columns}) < len(columns) or not set(EPISODE_COLUMNS) <= set(there):
        return None
    positions = [columns.index(column) for column in there]
    try:
        table = np.loadtxt(io.BytesIO(body), delimiter=",", usecols=positions, comments=None, ndmin=2) if body else None
    except ValueError:
        return None
    values = np.empty((len(there), 0)) if table is None else np.ascontiguousarray(table.T)
    return dict(zip(there, values, strict=True)), np.arange(2, values.shape[1] + 2), []


def _read_any(name: str, content: bytes) -> tuple[_Numbers, NDArray[np.int64], list[str]]:
    """Columns, lines and notes of a file as others write it."""
    table, notes = read_table(name, content, EPISODE_COLUMNS, _KNOWN), list[str]()
    if (line := table.cut) is not None:
        before, last = table.split(line)
        if not last.rows or any(_is_read(before, column) and not _is_read(last, column) for column in _KNOWN):
            table, notes = before, [_cut_off(line)]
    numbers = {column: to_numbers(table, column) for column in EPISODE_COLUMNS}
    if _is_read(table, VELOCITY_COLUMN):
        numbers[VELOCITY_COLUMN] = to_numbers(table, VELOCITY_COLUMN)
    elif VELOCITY_COLUMN in table.columns:
        notes.append(f"{VELOCITY_COLUMN} is left out, for it holds more than numbers")
    check_signs(table, list(numbers), _COUNTS)
    return numbers, np.array(table.lines, dtype=np.int64), notes


def _is_read(table: Table, column: str) -> bool:
    """Whether a column is there and holds numbers only."""
    try:
        return column in table.columns and to_numbers(table, column) is not None
    except DamagedError:
        return False


def _to_counts(name: str, column: str, values: NDArray[Any], lines: NDArray[np.int64]) -> NDArray[np.int64]:
    whole = np.isfinite(values) & (values == np.floor(values)) & (values > 0) & (values < 2.0**53)
    if not whole.all():
        row = int(np.argmin(whole))
        raise DamagedError(f"{name}: line {lines[row]}: {column} is {values[row]:g}, not a count of steps")
    return values.astype(np.int64)


def _odd_lengths(name: str, frame: pd.DataFrame, lines: NDArray[np.int64]) -> list[str]:
    """A note if an episode has not as many steps as passed since the one before: a number was changed."""
    passed = np.diff(frame["global_step"].to_numpy(), prepend=0)
    odd = np.flatnonzero(passed != frame["episode_length"].to_numpy())
    if not odd.size:
        return []
    row, more = int(odd[0]), f", and so in {odd.size - 1} more lines" if odd.size > 1 else ""
    length = frame["episode_length"].iloc[row]
    return [f"{name}: line {lines[row]}: an episode of {length} steps, {passed[row]} after the one before{more}"]


def _check_order(name: str, frame: pd.DataFrame, lines: NDArray[np.int64], own: bool) -> None:
    steps = frame["global_step"].to_numpy()
    ahead = np.diff(steps) > 0 if own else np.diff(steps) >= 0
    if not ahead.all():
        row = int(np.argmin(ahead)) + 1
        said = f"line {lines[row]} is at step {steps[row]}, the one before at {steps[row - 1]}"
        raise DamagedError(f"{name}: rows are not in order: {said}")

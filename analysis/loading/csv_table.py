"""A CSV file as other programs and people write it -> columns of numbers, or the line that cannot be read."""

from __future__ import annotations

import codecs
import csv
import re
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from acmr.records import DamagedError

#: What may part columns; None: blanks and tabs, however many. The header decides, as it holds no numbers.
_DELIMITERS = (",", ";", "\t", "|", None)
_BYTE_ORDER_MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
#: A number of which nobody knows whether its sign parts thousands or decimals.
_AMBIGUOUS = re.compile(r"[-+]?\d{1,3}[.,]\d{3}")


@dataclass(frozen=True)
class Table:
    """Rows of text.

    Attributes:
        name: The file's, for messages.
        columns: Names in the header.
        rows: Their values, as many in each row as there are columns.
        lines: The line in the file in which each row ends, the first being 1.
        cut: The last line, if the file ends in the middle of it: its row is there if it holds enough values.
    """

    name: str
    columns: list[str]
    rows: list[list[str]]
    lines: list[int]
    cut: int | None

    def split(self, line: int) -> tuple[Table, Table]:
        """The rows before a line, and those from it on."""
        at = bisect_left(self.lines, line)
        parts = ((self.rows[:at], self.lines[:at]), (self.rows[at:], self.lines[at:]))
        before, after = (replace(self, rows=rows, lines=lines) for rows, lines in parts)
        return before, after

    def values(self, column: str) -> list[str]:
        """The text in a column, (rows,)."""
        position = self.columns.index(column)
        return [row[position].strip() for row in self.rows]


def read_table(name: str, content: bytes, needed: Sequence[str], known: Sequence[str]) -> Table:
    """Parts a file into rows and columns.

    Read are UTF-8 and, with a byte order mark, UTF-16; columns parted by commas, semicolons, tabs, bars or blanks;
    values with or without quotation marks and blanks around them; every kind of line end. Lines that are empty or begin
    with ``#`` are passed over. The header may begin with ``#``, too, and Excel's ``sep=;`` may stand before it.

    Args:
        name: The file's.
        content: All of it.
        needed: Columns without which it is refused.
        known: Columns that must not be there twice.

    Raises:
        DamagedError: If a needed column is not there, a known one twice, or a line has more or fewer values.
    """
    text = _decode(content)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    start, columns, delimiter = _header(name, lines, needed)
    doubled = [column for column in known if columns.count(column) > 1]
    if doubled:
        count = columns.count(doubled[0])
        raise DamagedError(f"{name}: line {start + 1}: the column {doubled[0]} is there {count} times")
    last = lines[-1].strip()
    cut = len(lines) if last and not last.startswith("#") and len(lines) > start + 1 else None
    rows, numbers = [], []
    for number, row in _rows(name, lines, start + 1, delimiter):
        while len(row) > len(columns) and not row[-1].strip():
            row.pop()
        if len(row) != len(columns):
            if number == cut and len(row) < len(columns):
                break
            hint = " (decimal commas are read where ; or a tab parts the columns)" if len(row) > len(columns) else ""
            raise DamagedError(f"{name}: line {number} holds {len(row)} values, not {len(columns)}{hint}")
        rows.append(row)
        numbers.append(number)
    return Table(name, columns, rows, numbers, cut)


def to_numbers(table: Table, column: str) -> NDArray[np.float64]:
    """A column as numbers, with a decimal point or a decimal comma, (rows,).

    Raises:
        DamagedError: If a value is no number.
    """
    numbers = np.empty(len(table.rows))
    for row, (value, line) in enumerate(zip(table.values(column), table.lines, strict=True)):
        try:
            numbers[row] = float(value.replace(",", ".") if "." not in value else value)
        except ValueError:
            raise DamagedError(f"{table.name}: line {line}: {column} is {value[:20]!r}, not a number") from None
    return numbers


def check_signs(table: Table, columns: Sequence[str], counts: Sequence[str]) -> None:
    """Sees that what parts thousands is not taken for what parts decimals.

    Args:
        table: The file's rows.
        columns: Columns of numbers.
        counts: Those of them with whole numbers.

    Raises:
        DamagedError: If the numbers have both points and commas, or could be meant either way.
    """
    commas = [place for column in columns for place in _places(table, column, ",")]
    points = [place for column in columns for place in _places(table, column, ".")]
    if commas and points:
        line, column, value = max(commas[0], points[0])
        raise DamagedError(f"{table.name}: line {line}: {column} is {value!r}; elsewhere the other of . and , is used")
    for places in (commas, *([place for place in points if place[1] == column] for column in counts)):
        # One that has another number of digits shows what all are meant to be.
        if places and all(_AMBIGUOUS.fullmatch(value) for _, _, value in places):
            line, column, value = places[0]
            raise DamagedError(
                f"{table.name}: line {line}: {column} is {value!r}, of thousands or with decimals? "
                "Write numbers without separators of thousands and decimals with a point"
            )


def _places(table: Table, column: str, sign: str) -> list[tuple[int, str, str]]:
    values = zip(table.lines, table.values(column), strict=True)
    return [(line, column, value) for line, value in values if sign in value]


def _decode(content: bytes) -> str:
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS.items() if content.startswith(mark)), "utf-8")
    return content.decode(encoding, errors="replace")


def _header(name: str, lines: list[str], needed: Sequence[str]) -> tuple[int, list[str], str | None]:
    """Index of the header's line, its names, and what parts them."""
    for index, line in enumerate(lines):
        text = line.strip()
        for delimiter in _DELIMITERS:
            columns = _names(text.lstrip("# "), delimiter)
            if set(needed) <= set(columns):
                return index, columns, delimiter
        if text and not text.startswith(("#", "sep=")):
            columns = max((_names(text, delimiter) for delimiter in _DELIMITERS), key=len)
            missing = ", ".join(column for column in needed if column not in columns)
            raise DamagedError(f"{name}: no column {missing} (needed: {','.join(needed)})")
    raise DamagedError(f"{name}: no column {', '.join(needed)} (needed: {','.join(needed)})")


def _names(line: str, delimiter: str | None) -> list[str]:
    try:
        row = next(csv.reader([_blanks(line, delimiter)], delimiter=delimiter or " ", skipinitialspace=True), [])
    except csv.Error:
        return []
    names = [column.strip() for column in row]
    while names and not names[-1]:
        names.pop()
    return names


def _rows(name: str, lines: list[str], start: int, delimiter: str | None) -> Iterator[tuple[int, list[str]]]:
    """Number and values of each row that is neither empty nor a comment."""
    body = ("" if line.lstrip().startswith("#") else _blanks(line, delimiter) for line in lines[start:])
    reader = csv.reader((f"{line}\n" for line in body), delimiter=delimiter or " ", skipinitialspace=True, strict=True)
    first = start + 1
    try:
        for row in reader:
            if any(value.strip() for value in row):
                yield start + reader.line_num, row
            first = start + reader.line_num + 1
    except csv.Error as error:
        # Of quotation marks that do not end, the reader knows only where the file does.
        raise DamagedError(f"{name}: line {first}: {error}") from None


def _blanks(line: str, delimiter: str | None) -> str:
    return line if delimiter else " ".join(line.split())

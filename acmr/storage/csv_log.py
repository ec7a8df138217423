"""A CSV file that only grows and can be cut back to what it held at a checkpoint."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from acmr.storage.durable import Appender, FileDigest


class CsvLog:
    """A CSV file with fixed columns.

    Args:
        path: The file.
        columns: Its header.
        digest: What an earlier process had written of it; None: it is begun anew.

    Raises:
        DamagedError: If the file does not begin with that.
    """

    def __init__(self, path: Path, columns: Sequence[str], digest: FileDigest | None = None) -> None:
        self.columns = tuple(columns)
        self._file = Appender(path, digest)
        if digest is None:
            self.row(self.columns)

    def row(self, values: Iterable[object]) -> None:
        """Appends one row; floats keep every digit, None is empty."""
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(values)
        self._file.append(line.getvalue().encode())

    def sync(self) -> FileDigest:
        """Waits until every row is on the disk, and says what that is."""
        return self._file.sync()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

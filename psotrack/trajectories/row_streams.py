"""Tables of trajectories that are written while the rows come.

The bytes of the CSV file are those of `write_trajectories` for the same rows. It can be read while it grows.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from psotrack.errors import InputError, OutputError, system_errors
from psotrack.support import refuse_to_overwrite
from psotrack.trajectories.columns import columns_of
from psotrack.trajectories.files import csv_text
from psotrack.trajectories.trajectories import Trajectories


class RowStream:
    """A CSV table to which the rows of frames are added, as a context manager.

    Args:
        path: path that ends in .csv.
        force: replace an existing file; the first row does it, because the file grows row by row.
        record: file about the rows that the caller writes after them; None for none. An older one is removed with the
            older rows, because it is not about the new rows.

    Raises:
        InputError: the path has another suffix.
        OutputError: the file exists and `force` is not set, or it cannot be written. All complete rows so far stay.
    """

    def __init__(self, path: Path | str, *, force: bool = False, record: Path | None = None) -> None:
        self._path, self._record = Path(path), record
        if self._path.suffix != ".csv":
            raise InputError(
                self._path,
                expected="a name that ends in .csv, for rows that come one by one",
                found=repr(self._path.name),
                remedy="`psotrack export` makes other tables of it",
            )
        refuse_to_overwrite(self._path, force)
        self._num_bytes = 0

    def __enter__(self) -> RowStream:
        with self._errors():
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._replaces = self._path.is_file()
            # Appending, because an older file stays until the first row. Not buffered: what a full disk does not take
            # is known at once, and not written later.
            self._file = self._path.open("ab", buffering=0)
        return self

    def write(self, frame: Trajectories) -> None:
        """Add the rows of a frame, or of some frames, that come after those before."""
        rows = csv_text(columns_of(frame), header=not self._num_bytes).encode()
        with self._errors():
            if self._replaces:
                self._file.truncate(0)
                self._replaces = False
            # A link stays, and a device too.
            if not self._num_bytes and self._record is not None and self._record.is_file():
                self._record.resolve().unlink()
            rest = memoryview(rows)
            try:
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError:
                # A row that is cut off would make the table unreadable.
                with contextlib.suppress(OSError):
                    self._file.truncate(self._num_bytes)
                raise
        self._num_bytes += len(rows)

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        with self._errors():
            self._file.close()
        # An empty file would only be in the way of the next session. Links to devices stay, and so does an older file
        # after an error.
        if not self._num_bytes and self._path.is_file() and not (self._replaces and kind):
            self._path.unlink()

    def _errors(self) -> contextlib.AbstractContextManager[None]:
        kept = f"the rows that were written before stay in {self._path.name}" if self._num_bytes else ""
        return system_errors(self._path, "to write rows", OutputError, kept)

"""Tables of trajectories that are written while the rows come.

The bytes of a CSV file are those of `write_trajectories` for the same rows. A CSV file can be read while it grows. A
Parquet file cannot be read before it is complete, and so appears at the end. Until then its rows are in a CSV file
beside it, which a crash or a full disk leaves behind.
"""

from __future__ import annotations

import contextlib
import csv
import io
import logging
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from psotrack.errors import InputError, OutputError
from psotrack.support import atomic_write, refuse_to_overwrite
from psotrack.trajectories.columns import columns_of
from psotrack.trajectories.files import parquet_schema, words_of
from psotrack.trajectories.trajectories import Trajectories

if TYPE_CHECKING:
    import pyarrow as pa

logger = logging.getLogger(__name__)


class RowStream:
    """A table to which the rows of frames are added, as a context manager.

    The rows of a Parquet file NAME.parquet are in NAME.rows.csv until the end of the `with` block. Where the block ends
    with an error, or rows could not be written, they stay there, a line says so, and no Parquet file appears.

    Args:
        path: path that ends in .csv or .parquet.
        force: replace an existing file. The first row replaces a CSV file, because the file grows row by row; a Parquet
            file is replaced at the end.
        record: file about the rows that the caller writes after them; None for none. An older one is removed with the
            older rows, because it is not about the new rows.

    Raises:
        InputError: the path has another suffix.
        OutputError: the file, or NAME.rows.csv, exists and `force` is not set, or it cannot be written. All complete
            rows so far stay.
    """

    def __init__(self, path: Path | str, *, force: bool = False, record: Path | None = None) -> None:
        self._path, self._record = Path(path), record
        if self._path.suffix not in {".csv", ".parquet"}:
            expected = "a name that ends in .csv or .parquet"
            raise InputError(self._path, expected=expected, found=repr(self._path.name))
        self._is_parquet = self._path.suffix == ".parquet"
        self._rows_path = self._path.with_suffix(".rows.csv") if self._is_parquet else self._path
        for each in (self._path, self._rows_path):
            refuse_to_overwrite(each, force)
        self._types: dict[str, np.dtype] = {}
        self._num_bytes = 0
        self._has_failed = False

    def __enter__(self) -> RowStream:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._replaces = self._rows_path.is_file()
            # Appending, because an older file stays until the first row. Not buffered: what a full disk does not take
            # is known at once, and not written later.
            self._file = self._rows_path.open("ab", buffering=0)
        except OSError as error:
            raise self._error(error) from error
        return self

    def write(self, frame: Trajectories) -> None:
        """Add the rows of a frame, or of some frames, that come after those before."""
        columns = columns_of(frame)
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        if not self._num_bytes:
            self._types = {name: column.dtype for name, column in columns.items()}
            writer.writerow(columns)
        writer.writerows(words_of(columns))
        rows = text.getvalue().encode()
        try:
            if self._replaces:
                self._file.truncate(0)
                self._replaces = False
            if not (self._num_bytes or self._is_parquet):
                self._remove_older_record()
            rest = memoryview(rows)
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._has_failed = True
            # A row that is cut off would make the table unreadable.
            with contextlib.suppress(OSError):
                self._file.truncate(self._num_bytes)
            raise self._error(error) from error
        self._num_bytes += len(rows)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self._file.close()
        except OSError as failed:
            raise self._error(failed) from failed
        if not self._num_bytes:
            # An empty file would only be in the way of the next session. Links to devices stay, and so does an older
            # file after an error.
            if self._rows_path.is_file() and not (self._replaces and kind):
                self._rows_path.unlink()
            return
        if not self._is_parquet:
            return
        is_published = False
        try:
            if kind is None and not self._has_failed:
                self._publish()
                self._remove_older_record()
                self._rows_path.unlink()
                is_published = True
        finally:
            if not is_published:
                logger.warning("%s is not written; the rows so far are in %s", self._path, self._rows_path)

    def _remove_older_record(self) -> None:
        # A link stays, and a device too.
        if self._record is not None and self._record.is_file():
            self._record.resolve().unlink()

    def _publish(self) -> None:
        """Write the Parquet file from the rows, piece by piece."""
        import pyarrow as pa
        import pyarrow.csv as pc
        import pyarrow.parquet as pq

        schema = parquet_schema(list(self._types))
        # Numbers are read in the precision in which they were written, because they have the fewest digits for it.
        options = pc.ConvertOptions(column_types={name: _read_as(each) for name, each in self._types.items()})
        parsing = pc.ParseOptions(newlines_in_values=True)
        with (
            pc.open_csv(self._rows_path, parse_options=parsing, convert_options=options) as pieces,
            atomic_write(self._path) as temporary,
            pq.ParquetWriter(temporary, schema) as parquet,
        ):
            for piece in pieces:
                parquet.write_table(pa.Table.from_batches([piece]).cast(schema))

    def _error(self, error: OSError) -> OutputError:
        where = f"the rows that were written before stay in {self._rows_path.name}"
        return OutputError(
            self._path,
            expected="to write rows",
            found=(error.strerror or f"{error}").lower(),
            remedy=where if self._num_bytes else "",
        )


def _read_as(dtype: np.dtype) -> pa.DataType:
    import pyarrow as pa

    return pa.string() if dtype.kind in "UO" else pa.from_numpy_dtype(dtype)

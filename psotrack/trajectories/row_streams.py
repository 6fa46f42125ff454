"""Tables of trajectories that are written while the rows come: CSV row by row, Parquet in pieces.

The bytes of a CSV file are those of `write_trajectories` for the same rows. A CSV file can be read while it grows. A
Parquet file appears when it is complete, because a part of one cannot be read.
"""

from __future__ import annotations

import csv
import os
import secrets
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from psotrack.errors import InputError, OutputError
from psotrack.support import refuse_to_overwrite
from psotrack.trajectories.files import columns_of, parquet_table, words_of
from psotrack.trajectories.trajectories import Trajectories

if TYPE_CHECKING:
    import pyarrow.parquet as pq

#: Number of frames whose rows a Parquet file takes at once.
_PIECE_FRAMES = 500


class RowStream:
    """A table to which the rows of frames are added, as a context manager.

    Args:
        path: path that ends in .csv or .parquet.
        force: replace an existing file.

    Raises:
        InputError: the path has another suffix.
        OutputError: the file exists and `force` is not set, or it cannot be written. The rows of a CSV file so far
            stay.
    """

    def __init__(self, path: Path | str, *, force: bool = False) -> None:
        self._path = Path(path)
        if self._path.suffix not in {".csv", ".parquet"}:
            expected = "a name that ends in .csv or .parquet"
            raise InputError(self._path, expected=expected, found=repr(self._path.name))
        refuse_to_overwrite(self._path, force)
        self._pieces: list[Trajectories] = []
        self._parquet: pq.ParquetWriter | None = None
        self._has_header = False
        hidden = f".{self._path.name}.{secrets.token_hex(4)}.partial"
        is_csv = self._path.suffix == ".csv"
        self._temporary = self._path if is_csv else self._path.with_name(hidden)

    def __enter__(self) -> RowStream:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._temporary.open("w", encoding="utf-8", newline="") if self._is_csv else None
        except OSError as error:
            raise self._error(error) from error
        return self

    @property
    def _is_csv(self) -> bool:
        return self._path.suffix == ".csv"

    def write(self, frame: Trajectories) -> None:
        """Add the rows of a frame, or of some frames, that come after those before."""
        try:
            if self._file is not None:
                columns = columns_of(frame)
                writer = csv.writer(self._file, lineterminator="\n")
                if not self._has_header:
                    writer.writerow(columns)
                    self._has_header = True
                writer.writerows(words_of(columns))
                self._file.flush()
                return
            self._pieces.append(frame)
            if len(self._pieces) >= _PIECE_FRAMES:
                self._write_pieces()
        except OSError as error:
            raise self._error(error) from error

    def _write_pieces(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not self._pieces:
            return
        table = pa.concat_tables([parquet_table(columns_of(piece)) for piece in self._pieces])
        if self._parquet is None:
            self._parquet = pq.ParquetWriter(self._temporary, table.schema)
        self._parquet.write_table(table)
        self._pieces = []

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if self._file is not None:
                self._file.close()
                return
            self._write_pieces()
            if self._parquet is not None:
                self._parquet.close()
                os.replace(self._temporary, self._path)
        except OSError as failed:
            raise self._error(failed) from failed

    def _error(self, error: OSError) -> OutputError:
        return OutputError(
            self._path,
            expected="to write rows",
            found=error.strerror or f"{error}",
            remedy="the rows that were written before stay" if self._is_csv else "",
        )

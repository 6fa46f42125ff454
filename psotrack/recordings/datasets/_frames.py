"""Rows of a table by the numbers of their frames."""

from __future__ import annotations

from psotrack.support import Column, Table, TextRow

#: Largest number of a frame, whatever the number of rows, and per row: arrays over all frames take memory.
_FRAMES, _FRAMES_PER_ROW = 1_000_000, 100


def rows_by_frame(table: Table, column: Column) -> dict[int, TextRow]:
    """Rows by frame.

    Args:
        table: the table.
        column: the column with the numbers of the frames.

    Raises:
        InputError: a number is no whole number or is far above the number of rows, or a frame occurs twice. The message
            names the line.
    """
    rows: dict[int, TextRow] = {}
    for row in table.rows:
        frame = row.count(column)
        if frame in rows:
            raise row.error(column, "each frame once", f"{frame} again, after line {rows[frame].line}")
        rows[frame] = row
    last, most = max(rows), max(_FRAMES, _FRAMES_PER_ROW * len(rows))
    if last > most:
        expected = f"a frame number of at most {most} in a file of {len(rows)} rows"
        raise rows[last].error(column, expected, f"{last}")
    return rows

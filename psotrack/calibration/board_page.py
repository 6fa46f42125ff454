"""A board to print: a page in its true size, with what to tell the calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psotrack.calibration.boards import Board
from psotrack.errors import SettingsError
from psotrack.support import atomic_write, refuse_to_overwrite

#: White border about a board, in sides of a square; resolution of a square, pixels; millimetres of an inch.
_BORDER, _SQUARE_PX, _INCH_MM = 1.0, 120, 25.4
_SUFFIXES = (".pdf", ".png", ".svg")


def save_board(path: Path | str, board: Board, *, force: bool = False) -> Path:
    """Draw a ChArUco board to print at 100 %.

    Args:
        path: file of the page, .pdf, .png or .svg.
        board: the board.
        force: whether an existing file is replaced.

    Raises:
        SettingsError: the file has another ending.
        OutputError: the file exists and `force` is not set, or cannot be written.
    """
    from matplotlib.figure import Figure

    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise SettingsError("board", expected=f"a file that ends in {', '.join(_SUFFIXES)}", found=path.name)
    refuse_to_overwrite(path, force)
    columns, rows = board.squares_wh
    drawn = board.opencv().generateImage((columns * _SQUARE_PX, rows * _SQUARE_PX))
    size = np.array([columns, rows]) + 2 * _BORDER
    figure = Figure(figsize=tuple(1e3 * board.square_m / _INCH_MM * size))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, size[0]), ylim=(0, size[1]))
    axes.axis("off")
    edges = (_BORDER, _BORDER + columns, _BORDER, _BORDER + rows)
    axes.imshow(drawn, cmap="gray", vmin=0, vmax=255, extent=edges, interpolation="nearest")
    axes.set(xlim=(0, size[0]), ylim=(0, size[1]))
    words = f"{columns} x {rows} squares of {1e3 * board.square_m:g} mm, dictionary {board.dictionary}: print at 100 %"
    axes.text(_BORDER, _BORDER / 2, words, fontsize=8, va="center")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=300)
    return path

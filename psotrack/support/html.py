"""Small pieces of HTML with which results show themselves in notebooks.

All text is escaped. The pieces take no colours of their own but those of drones and a grey that both light and dark
pages show; they need neither a style sheet nor a script, which viewers of saved notebooks remove. Pictures are images
in the page's own text, because the same viewers remove bare SVG.
"""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from psotrack.support.figures import drone_colour

#: Colour of lines and text in pictures, readable on light and dark pages.
_GREY = "#888888"
_CELL = "padding: 1px 8px; text-align: {side}; border: 0"
#: Largest number of points of a path in a picture, and the picture's longer side, pixels.
_MOST_POINTS, _PICTURE_PX = 300, 260
#: Space around the paths, pixels.
_MARGIN_PX = 14


def html_block(title: str, *parts: str) -> str:
    """A title above parts, which are HTML."""
    return f"<div><div><b>{html.escape(title)}</b></div>{''.join(parts)}</div>"


def html_lines(lines: Mapping[str, str]) -> str:
    """One line for each label: the label and its text; nothing without lines."""
    rows = "".join(
        f"<tr>{_cell(label, 'left', 'th')}{_cell(text, 'left')}</tr>" for label, text in lines.items() if text
    )
    return f"<table>{rows}</table>" if rows else ""


def html_table(headings: Sequence[str], rows: Iterable[Sequence[str]], *, coloured: bool = False) -> str:
    """A table of texts, the first column to the left and the others, which are numbers, to the right.

    Args:
        headings: one per column.
        rows: texts of the cells.
        coloured: whether a square in the drone's colour stands before the first cell, as in `html_paths`.
    """
    sides = ["left"] + ["right"] * (len(headings) - 1)
    head = "".join(_cell(text, side, "th") for text, side in zip(headings, sides, strict=True))
    body = ""
    for number, row in enumerate(rows):
        mark = f'<span style="color: {drone_colour(number)}">&#9632;</span> ' if coloured else ""
        first, *others = (_cell(text, side) for text, side in zip(row, sides, strict=True))
        body += f"<tr>{first.replace('>', f'>{mark}', 1)}{''.join(others)}</tr>"
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def html_paths(position_m: Float[np.ndarray, "frames drones 3"]) -> str:
    """A picture of paths seen from above, x to the right and y up, with a scale; nothing without a position.

    Args:
        position_m: (frames, drones, 3), positions, metres; NaN interrupts a path.
    """
    every = max(1, math.ceil(len(position_m) / _MOST_POINTS))
    paths_m = position_m[::every, :, :2].astype(np.float64)
    known = np.asarray(np.isfinite(paths_m).all(axis=-1))
    if not known.any():
        return ""
    low_m, high_m = paths_m[known].min(axis=0), paths_m[known].max(axis=0)
    metres = max(float((high_m - low_m).max()), 0.1)
    per_metre = _PICTURE_PX / metres
    size_px = (high_m - low_m) * per_metre + 2 * _MARGIN_PX
    lines = "".join(
        f'<polyline points="{_points(part_m, low_m, high_m, per_metre)}" fill="none" stroke="{drone_colour(drone)}" '
        'stroke-width="2" stroke-linecap="round" stroke-linejoin="round"/>'
        for drone in range(paths_m.shape[1])
        for part_m in _parts(paths_m[:, drone], known[:, drone])
    )
    scale_m = _round_length(metres / 3)
    width, height = max(size_px[0], scale_m * per_metre + 80), size_px[1] + 16
    end = _MARGIN_PX + scale_m * per_metre
    scale = (
        f'<path d="M{_MARGIN_PX} {height - 10:.0f}H{end:.1f}" stroke="{_GREY}" stroke-width="2"/>'
        f'<text x="{end + 6:.1f}" y="{height - 6:.0f}" font-family="sans-serif" font-size="12" fill="{_GREY}">'
        f"{scale_m:g} m</text>"
    )
    picture = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}">{lines}{scale}</svg>'
    data = base64.b64encode(picture.encode()).decode()
    return f'<img alt="paths from above" src="data:image/svg+xml;base64,{data}"/>'


def _cell(text: str, side: str, kind: str = "td") -> str:
    # Columns of numbers stay on one line; sentences, which are on the left, are folded.
    style = _CELL.format(side=side) + ("; white-space: nowrap" if side == "right" else "")
    return f'<{kind} style="{style}">{html.escape(text)}</{kind}>'


def _parts(path_m: np.ndarray, known: np.ndarray) -> list[np.ndarray]:
    """The pieces of a path between gaps; a piece of one point becomes a dot."""
    pieces = np.split(np.arange(len(known)), np.flatnonzero(np.diff(known)) + 1)
    shown = [path_m[piece] for piece in pieces if len(piece) and known[piece[0]]]
    return [np.repeat(piece, 2, axis=0) if len(piece) == 1 else piece for piece in shown]


def _points(path_m: np.ndarray, low_m: np.ndarray, high_m: np.ndarray, per_metre: float) -> str:
    x_px = _MARGIN_PX + (path_m[:, 0] - low_m[0]) * per_metre
    y_px = _MARGIN_PX + (high_m[1] - path_m[:, 1]) * per_metre
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(x_px, y_px, strict=True))


def _round_length(length: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= length * (1 + 1e-9))

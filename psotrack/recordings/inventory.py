"""Inventory of a recording as a table: the command `psotrack init --show`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from psotrack.support import html_block, html_table

if TYPE_CHECKING:
    from rich.table import Table

_HEADINGS = ("camera", "video", "frames", "fps", "size", "f (px)", "centre (m)", "detections")


def inventory_table(content: dict[str, Any]) -> Table:
    """Table with one row per camera; cameras on drones come last.

    Args:
        content: plain data from `Recording.to_dict`.
    """
    from rich import box
    from rich.table import Table

    table = Table(title=_heading(content), title_justify="left", box=box.HORIZONTALS, show_edge=False)
    for name in _HEADINGS:
        left = name in ("camera", "video")
        table.add_column(name, justify="left" if left else "right", overflow="fold" if left else "ellipsis")
    for row in _rows(content):
        table.add_row(*row)
    return table


def inventory_html(content: dict[str, Any]) -> str:
    """The same table as HTML for notebooks."""
    return html_block(_heading(content), html_table(_HEADINGS, _rows(content)))


def _heading(content: dict[str, Any]) -> str:
    """Name, length and reference of a recording."""
    drones = content["drones"]
    reference = (
        f"reference of {', '.join(drones)} in {content['frames_with_truth']} frames"
        if drones is not None
        else "no reference"
    )
    length = f"{content['instants']} instants at {content['rate_hz']:g} Hz, " if content["rate_hz"] else ""
    return f"{content['name']}: {length}{reference}"


def _rows(content: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Cells of each camera, and of each camera on a drone."""
    for name, camera in content["cameras"].items():
        yield (
            name,
            _shown(camera),
            "" if camera["frames"] is None else f"{camera['frames']}{_begin(camera['begins_s'])}",
            "" if camera["fps"] is None else f"{camera['fps']:g}",
            _size(camera["image_size_wh"]),
            "" if camera["focal_length_px"] is None else f"{camera['focal_length_px']:.1f}",
            "no place" if not camera["placed"] else " ".join(f"{value:.2f}" for value in camera["centre_m"]),
            "" if camera["detections"] is None else f"{camera['detections']}",
        )
    for name, camera in (content["onboard"] or {}).items():
        focal_length_px = camera["focal_length_px"]
        yield (
            f"on {name}",
            _name(camera["video"]),
            f"{camera['frames']}",
            f"{camera['fps']:g}",
            _size(camera["image_size_wh"]),
            "" if focal_length_px is None else f"{focal_length_px:.1f}",
            f"{camera['frames_with_pose']} poses",
            "",
        )


def _shown(camera: dict[str, Any]) -> str:
    """What there is of a camera's images."""
    if camera["video"] is not None:
        return _name(camera["video"])
    return "no video" if camera["silhouettes"] is None else "silhouettes only"


def _name(video: str) -> str:
    """Name of a file; a stream's address as it is."""
    return video if "://" in video else video.replace("\\", "/").rpartition("/")[2]


def _begin(begins_s: float | None) -> str:
    """When a camera begins, where this is not at time 0."""
    return f" from {begins_s:.3f} s" if begins_s else ""


def _size(size_wh: list[int] | None) -> str:
    return "" if size_wh is None else f"{size_wh[0]} x {size_wh[1]}"

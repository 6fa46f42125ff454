"""Inventory of a recording as a table: the command `psotrack init --show`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from psotrack.support import html_block, html_table

_HEADINGS = ("camera", "video", "frames", "fps", "size", "f (px)", "centre (m)", "detections")


def inventory(content: dict[str, Any]) -> tuple[str, tuple[str, ...], list[tuple[str, ...]]]:
    """Title, headings and rows of the table: one row per camera; cameras on drones come last.

    Args:
        content: plain data from `Recording.to_dict`.
    """
    return _heading(content), _HEADINGS, list(_rows(content))


def inventory_html(content: dict[str, Any]) -> str:
    """The same table as HTML for notebooks."""
    title, headings, rows = inventory(content)
    return html_block(title, html_table(headings, rows))


def _heading(content: dict[str, Any]) -> str:
    """Name, length and reference of a recording."""
    drones = content["drones"]
    reference = "no reference"
    if drones is not None:
        reference = f"reference of {', '.join(drones)} in {content['frames_with_truth']} frames"
    length = f"{content['instants']} instants at {content['rate_hz']:g} Hz, " if content["rate_hz"] else ""
    return f"{content['name']}: {length}{reference}"


def _rows(content: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Cells of each camera, and of each camera on a drone."""
    for name, camera in content["cameras"].items():
        images = "no video" if camera["silhouettes"] is None else "silhouettes only"
        place = "no place"
        if camera["placed"]:
            place = " ".join(f"{value:.2f}" for value in camera["centre_m"])
        yield _row(name, camera, camera["video"] or images, place, camera["detections"])
    for name, camera in (content["onboard"] or {}).items():
        yield _row(f"on {name}", camera, camera["video"], f"{camera['frames_with_pose']} poses", None)


def _row(
    name: str, camera: dict[str, Any], video: str, place: str, detections: int | None
) -> tuple[str, ...]:
    """Cells of a camera; what is not known is empty. Of a file the name is shown, a stream's address as it is."""
    begins_s, size_wh = camera.get("begins_s"), camera["image_size_wh"]
    begin = f" from {begins_s:.3f} s" if begins_s else ""
    return (
        name,
        video if "://" in video else video.replace("\\", "/").rpartition("/")[2],
        "" if camera["frames"] is None else f"{camera['frames']}{begin}",
        "" if camera["fps"] is None else f"{camera['fps']:g}",
        "" if size_wh is None else f"{size_wh[0]} x {size_wh[1]}",
        "" if camera["focal_length_px"] is None else f"{camera['focal_length_px']:.1f}",
        place,
        "" if detections is None else f"{detections}",
    )

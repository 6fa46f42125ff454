"""Inventory of a recording, as a JSON record and as a table: the command `psotrack init --show`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from psotrack.recordings.detections import read_detections
from psotrack.recordings.recording import Recording
from psotrack.support import html_block, html_table

if TYPE_CHECKING:
    from rich.table import Table

_HEADINGS = ("camera", "video", "frames", "fps", "size", "f (px)", "centre (m)", "detections")


def describe_recording(recording: Recording) -> dict[str, Any]:
    """Cameras, videos, detections and reference of a recording, as plain data. All detections are read.

    Raises:
        InputError: a file of detections cannot be read.
    """
    names = (*recording.rig.names, *recording.unplaced)
    onboard: dict[str, dict[str, Any]] = {}
    for name, flown in (recording.onboard or {}).items():
        onboard[name] = {
            "video": str(flown.video.path),
            "frames": flown.video.num_frames,
            "fps": flown.video.fps,
            "image_size_wh": list(flown.video.image_size_wh),
            "focal_length_px": None if flown.K is None else float(flown.K[0, 0]),
            "frames_with_pose": int(np.isfinite(flown.orientation_wxyz).all(axis=1).sum()),
        }
    truth = recording.truth
    timed = bool(recording.frame_times)
    return {
        "name": recording.name,
        "folder": str(recording.folder),
        "cameras": {name: _describe_camera(recording, name) for name in names},
        "onboard": onboard or None,
        "drones": list(truth.drones) if truth else None,
        "frames_with_truth": int(np.count_nonzero(truth.seen.any(axis=1))) if truth else None,
        "rate_hz": recording.fps if timed else None,
        "instants": recording.num_frames if timed else 0,
        "bounds_m": None if recording.bounds_m is None else list(recording.bounds_m),
        "reference_files": [str(path) for path in recording.reference_files],
        "marker_corners": None if recording.marker_corners is None else str(recording.marker_corners),
    }


def _describe_camera(recording: Recording, name: str) -> dict[str, Any]:
    video, times = recording.videos.get(name), recording.frame_times.get(name)
    detections = (recording.detections or {}).get(name)
    ignore, silhouettes = recording.ignore.get(name), recording.silhouettes.get(name)
    described: dict[str, Any] = {
        "video": str(video.path) if video else recording.streams.get(name),
        "silhouettes": None if silhouettes is None else str(silhouettes.path),
        "frames": times.num_frames if times else None,
        "fps": times.fps if times else None,
        "begins_s": float(times.time_s[0]) if times and times.num_frames else None,
        "image_size_wh": list(video.image_size_wh) if video else None,
        "focal_length_px": None,
        "centre_m": None,
        "placed": name in recording.rig.names,
        "detections": len(read_detections(detections)) if detections else None,
        "ignore": None if ignore is None else str(ignore),
    }
    if described["placed"]:
        cam = recording.rig.cameras[recording.rig.names.index(name)]
        described["image_size_wh"] = [int(side) for side in cam.image_size_wh]
        described["focal_length_px"] = float(cam.K[0, 0])
        described["centre_m"] = [round(float(value), 4) for value in cam.centre_world]
    return described


def inventory_table(content: dict[str, Any]) -> Table:
    """Table with one row per camera; cameras on drones come last.

    Args:
        content: record from `describe_recording`.
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

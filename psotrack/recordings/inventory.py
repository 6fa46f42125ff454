"""Inventory of a sequence, as a JSON record and as a table: the command `psotrack info`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from psotrack.recordings.detections import read_detections
from psotrack.recordings.recording import Recording

if TYPE_CHECKING:
    from rich.table import Table


def describe_recording(recording: Recording) -> dict[str, Any]:
    """Cameras, videos, detections and reference of a sequence, as plain data. All detections are read.

    Raises:
        InputError: a file of detections cannot be read.
    """
    cameras: dict[str, dict[str, Any]] = {}
    for index, name in enumerate(recording.rig.names):
        cam, video = recording.rig.cameras[index], recording.videos.get(name)
        detections = (recording.detections or {}).get(name)
        cameras[name] = {
            "video": str(video.path) if video else None,
            "frames": video.num_frames if video else None,
            "fps": video.fps if video else None,
            "image_size_wh": [int(side) for side in cam.image_size_wh],
            "focal_length_px": float(cam.K[0, 0]),
            "centre_m": [round(float(value), 4) for value in cam.centre_world],
            "detections": len(read_detections(detections)) if detections else None,
        }
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
    return {
        "name": recording.name,
        "folder": str(recording.folder),
        "cameras": cameras,
        "onboard": onboard or None,
        "drones": list(truth.drones) if truth else None,
        "frames_with_truth": int(np.count_nonzero(truth.seen.any(axis=1))) if truth else None,
    }


def inventory_table(content: dict[str, Any]) -> Table:
    """Table with one row per camera; cameras on drones come last.

    Args:
        content: record from `describe_recording`.
    """
    from rich import box
    from rich.table import Table

    drones = content["drones"]
    reference = (
        f"reference of {', '.join(drones)} in {content['frames_with_truth']} frames"
        if drones is not None
        else "no reference"
    )
    table = Table(
        title=f"{content['name']}: {reference}", title_justify="left", box=box.HORIZONTALS, show_edge=False
    )
    for name in ("camera", "frames", "fps", "size", "f (px)", "centre (m)", "detections"):
        table.add_column(name, justify="left" if name == "camera" else "right")
    for name, camera in content["cameras"].items():
        width, height = camera["image_size_wh"]
        table.add_row(
            name,
            "no video" if camera["frames"] is None else f"{camera['frames']}",
            "" if camera["fps"] is None else f"{camera['fps']:g}",
            f"{width} x {height}",
            f"{camera['focal_length_px']:.1f}",
            " ".join(f"{value:.2f}" for value in camera["centre_m"]),
            "" if camera["detections"] is None else f"{camera['detections']}",
        )
    for name, camera in (content["onboard"] or {}).items():
        width, height = camera["image_size_wh"]
        focal_length_px = camera["focal_length_px"]
        table.add_row(
            f"on {name}",
            f"{camera['frames']}",
            f"{camera['fps']:g}",
            f"{width} x {height}",
            "" if focal_length_px is None else f"{focal_length_px:.1f}",
            f"{camera['frames_with_pose']} poses",
            "",
        )
    return table

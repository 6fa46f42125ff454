"""The ways from stored markers to poses that Table 7 compares: the paper's, and ours in its three stages."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from _recordings import Recording
from _sightings import Sightings

from psotrack.inside_out import CameraPath, LocaliseSettings, PoseSettings, smooth
from psotrack.inside_out.detection import DetectedMarkers
from psotrack.inside_out.filtering.path_rows import join_rows
from psotrack.inside_out.localising import localise_frames, pose_row
from psotrack.inside_out.pose import MarkerPose

#: What the paper asks for.
MIN_MARKERS = 4


def paths(recording: Recording, seen: Sightings) -> dict[str, CameraPath]:
    """A path by each method."""
    markers = [_known(recording, seen, frame) for frame in range(recording.video.num_frames)]
    settings = LocaliseSettings(pose=PoseSettings(min_markers=MIN_MARKERS))
    single = replace(settings, filter=None)
    raw, filtered = _followed(recording, markers, settings)
    return {
        "paper": join_rows([pose_row(*one, _of_all(one[2], recording), single) for one in markers]),
        "single frames": _followed(recording, markers, single)[0],
        "filter": filtered,
        "smoother": smooth(raw),
    }


_Markers = tuple[int, float, DetectedMarkers]


def _known(recording: Recording, seen: Sightings, frame: int) -> _Markers:
    """The markers of the map in a frame."""
    markers = seen.in_frame(frame)
    known = markers.select(np.isin(markers.ids, recording.marker_map.ids))
    return frame, frame / recording.video.fps, known


def _followed(
    recording: Recording, markers: list[_Markers], settings: LocaliseSettings
) -> tuple[CameraPath, CameraPath]:
    """Each frame's own poses, and what the filter makes of them."""
    rows = list(localise_frames(markers, recording.marker_map, recording.lens, settings))
    return join_rows([raw for raw, _ in rows]), join_rows([row for _, row in rows])


def _of_all(markers: DetectedMarkers, recording: Recording) -> MarkerPose | None:
    """The least squares of all corners of all markers, right and wrong ones alike: the paper's way."""
    if len(markers) < MIN_MARKERS:
        return None
    lens = recording.lens
    points_m = recording.marker_map.corners_of(markers.ids.tolist()).reshape(-1, 3)
    points_px = markers.corners_px.reshape(-1, 2)
    found, turn, t = cv2.solvePnP(points_m, points_px, lens.K, lens.dist, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        return None
    turn, t = cv2.solvePnPRefineLM(points_m, points_px, lens.K, lens.dist, turn, t)
    R = cv2.Rodrigues(turn)[0]
    again_px, _ = cv2.projectPoints(points_m, turn, t, lens.K, lens.dist)
    squared_px = ((again_px[:, 0] - points_px) ** 2).sum(axis=-1)
    return MarkerPose(
        position_m=(-R.T @ t)[:, 0],
        R_world_cam=R.T,
        covariance=np.full((6, 6), np.nan),
        used=np.ones(len(markers), bool),
        reprojection_px=float(np.sqrt(squared_px.mean())),
        ambiguity=0.0,
        common=np.zeros((6, 0)),
        chance=1.0,
    )

"""Methods from stored markers to poses that Table 7 compares: the paper's, and the three of `localise`."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from _recordings import Recording
from _sightings import Sightings

from psotrack.foreground.markers import DetectedMarkers
from psotrack.inside_out import CameraPath, LocaliseSettings, PoseSettings
from psotrack.inside_out.localising import FollowedFrame, localise_frames, own_path
from psotrack.inside_out.pose import MarkerPose

#: Smallest number of markers of a pose in the paper.
MIN_MARKERS = 4


def paths(recording: Recording, seen: Sightings) -> dict[str, CameraPath]:
    """Compute the camera's path by each method; the last three are what `psotrack onboard localise` writes."""
    markers = [_markers_in_map(recording, seen, frame) for frame in range(recording.video.num_frames)]
    settings = LocaliseSettings(pose=PoseSettings(min_markers=MIN_MARKERS))
    found = localise_frames(markers, recording.marker_map, recording.lens, settings)
    single = localise_frames(markers, recording.marker_map, recording.lens, replace(settings, filter=None))
    return {
        "paper": _paper_path(markers, recording),
        "single frames": single.path,
        "filter": found.path,
        "smoother": found.smoothed(),
    }


_Markers = tuple[int, float, DetectedMarkers]


def _markers_in_map(recording: Recording, seen: Sightings, frame: int) -> _Markers:
    """Number, time (seconds) and markers of a frame, without markers that are not in the map."""
    markers = seen.in_frame(frame)
    known = markers.select(np.isin(markers.ids, recording.marker_map.ids))
    return frame, frame / recording.video.fps, known


def _paper_path(markers: list[_Markers], recording: Recording) -> CameraPath:
    """The path of the paper's poses."""
    frames = [
        FollowedFrame(number, time_s, len(seen), _paper_pose(seen, recording))
        for number, time_s, seen in markers
    ]
    return own_path(frames, PoseSettings(min_markers=MIN_MARKERS))


def _paper_pose(markers: DetectedMarkers, recording: Recording) -> MarkerPose | None:
    """Pose by least squares of all corners of all markers, without rejection of outliers: the paper's method."""
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
        num_markers=len(markers),
        used=np.ones(len(markers), bool),
        reprojection_px=float(np.sqrt(squared_px.mean())),
        ambiguity=0.0,
    )

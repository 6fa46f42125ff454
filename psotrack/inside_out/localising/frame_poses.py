"""Poses of frames whose markers are detected: each frame's own pose, and the filter's estimate."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.geometry import Camera
from psotrack.inside_out.camera_path import Flag
from psotrack.inside_out.detection import DetectedMarkers
from psotrack.inside_out.filtering.path_rows import PoseRow
from psotrack.inside_out.filtering.pose_filter import FilterRun, advance, expected, step
from psotrack.inside_out.localising.records import STAGES, LocaliseSettings
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import ExpectedPose, MarkerPose, PoseSettings, estimate_pose
from psotrack.trajectories import Status

#: Number of markers that the paper requires. A pose from fewer markers is flagged, even if the settings allow it.
PAPER_MARKERS = 4
#: Probability that another pose is the right one above which a pose is flagged as ambiguous.
_AMBIGUOUS = 0.05


def localise_frames(
    detected: Iterable[tuple[int, float, DetectedMarkers]],
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings,
    seconds: dict[str, float] | None = None,
) -> Iterator[tuple[PoseRow, PoseRow]]:
    """Each frame's own pose and the filter's estimate, frame by frame; the two are equal without a filter.

    Args:
        detected: number and time (seconds) of each frame, and its markers, which are all in the map.
        marker_map: map of the room.
        lens: intrinsics of the camera.
        settings: settings; the dictionary is not used.
        seconds: times by stage; the times of "locate" and "filter" are added.
    """
    spent_s = dict.fromkeys(STAGES, 0.0) if seconds is None else seconds
    run = FilterRun()
    for number, time_s, markers in detected:
        began_s = time.perf_counter()
        if settings.filter is not None:
            run = advance(run, time_s, settings.filter)
        predicted_s = time.perf_counter()
        pose = _pose_of_frame(markers, marker_map, lens, settings, run)
        raw = pose_row(number, time_s, markers, pose, settings)
        raw = replace(raw, common=_common(markers, pose, marker_map, settings.pose))
        located_s = time.perf_counter()
        row = raw
        if settings.filter is not None:
            run, row = step(run, raw, settings.filter)
        spent_s["locate"] += located_s - predicted_s
        spent_s["filter"] += time.perf_counter() - located_s + predicted_s - began_s
        yield raw, row


def pose_row(
    number: int,
    time_s: float,
    markers: DetectedMarkers,
    pose: MarkerPose | None,
    settings: LocaliseSettings,
) -> PoseRow:
    """A frame of a path with its own pose; without a pose, the number of markers counts the detected markers."""
    num_markers = len(markers) if pose is None else int(pose.used.sum())
    flags = Flag(0)
    if 0 < num_markers < max(PAPER_MARKERS, settings.pose.min_markers):
        flags |= Flag.FEW_MARKERS
    if pose is not None and pose.ambiguity > _AMBIGUOUS:
        flags |= Flag.AMBIGUOUS
    unknown = np.full(3, np.nan)
    return PoseRow(
        frame=number,
        time_s=time_s,
        position_m=unknown if pose is None else pose.position_m,
        orientation_wxyz=np.full(4, np.nan)
        if pose is None
        else Rotation.from_matrix(pose.R_world_cam).as_quat(scalar_first=True),
        covariance=np.full((6, 6), np.nan) if pose is None else pose.covariance,
        num_markers=num_markers,
        reprojection_px=np.nan if pose is None else float(pose.reprojection_px),
        ambiguity=np.nan if pose is None else float(pose.ambiguity),
        status=int(Status.LOST if pose is None else Status.TRACKED),
        flags=int(flags),
        velocity_m_s=unknown,
        chance=np.nan if pose is None else pose.chance,
    )


def _pose_of_frame(
    markers: DetectedMarkers,
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings,
    run: FilterRun,
) -> MarkerPose | None:
    """The pose by one frame's markers; the filter's prediction decides between poses that fit about equally well."""
    predicted = None if settings.filter is None else expected(run, settings.filter)
    prior = (
        None
        if predicted is None
        else ExpectedPose(predicted.position_m, predicted.R_world_cam, predicted.covariance)
    )
    return estimate_pose(
        markers.corners_px, marker_map.corners_of(markers.ids.tolist()), lens, settings.pose, prior
    )


def _common(
    markers: DetectedMarkers, pose: MarkerPose | None, marker_map: MarkerMap, settings: PoseSettings
) -> Float[np.ndarray, "6 errors"]:
    """Change of a pose by errors of the markers in the map and of the focal length; 0 columns if none are stated."""
    if not settings.map_error_m and not settings.focal_error:
        return np.zeros((6, 0))
    common = np.zeros((6, 3 * len(marker_map) + 1))
    if pose is not None:
        first = 3 * np.searchsorted(marker_map.ids, markers.ids)
        common[:, (first[:, None] + np.arange(3)).ravel()] = pose.common[:, :-1]
        common[:, -1] = pose.common[:, -1]
    return common

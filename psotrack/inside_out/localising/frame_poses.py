"""Poses of frames whose markers are detected: each frame's own pose, and the filter's estimate."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import Camera
from psotrack.inside_out.camera_path import Flag
from psotrack.inside_out.filtering import PoseFilterParams
from psotrack.inside_out.filtering.path_rows import PoseRow, join_rows
from psotrack.inside_out.filtering.pose_filter import FilterRun, advance, expected, step
from psotrack.inside_out.filtering.records import PoseEstimate
from psotrack.inside_out.filtering.smoothing import first_estimate
from psotrack.inside_out.localising.records import STAGES, LocaliseSettings
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import (
    ExpectedMotion,
    ExpectedPose,
    MarkerPose,
    PoseSettings,
    RollingShutter,
    estimate_pose,
)
from psotrack.trajectories import Status

#: Number of markers that the paper requires. A pose from fewer markers is flagged, even if the settings allow it.
PAPER_MARKERS = 4
#: Number of frames that tell the motion in the first one, and smallest such number.
_FIRST_FRAMES, _FEWEST_FIRST = 10, 4
#: Probability that another pose is the right one above which a pose is flagged as ambiguous.
_AMBIGUOUS = 0.05


@dataclass(frozen=True)
class FirstMotion:
    """Motion of a camera in the first frame of a recording that is located.

    Attributes:
        time_s: time of the frame, seconds.
        motion: motion in this frame.
    """

    time_s: float
    motion: ExpectedMotion


def localise_frames(
    detected: Iterable[tuple[int, float, DetectedMarkers]],
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings,
    seconds: dict[str, float] | None = None,
    first: FirstMotion | None = None,
) -> Iterator[tuple[PoseRow, PoseRow]]:
    """Each frame's own pose and the filter's estimate, frame by frame; the two are equal without a filter.

    Args:
        detected: number and time (seconds) of each frame, and its markers, which are all in the map.
        marker_map: map of the room.
        lens: intrinsics of the camera.
        settings: settings; the dictionary is not used.
        seconds: times by stage; the times of "locate" and "filter" are added.
        first: motion in a frame before which nothing is known of the motion; None if it is not known.
    """
    spent_s = dict.fromkeys(STAGES, 0.0) if seconds is None else seconds
    run, shutter = FilterRun(), settings.shutter or RollingShutter(0.0)
    # Where the shutter rolls, a frame's own pose depends on the motion, which the filter follows.
    rolls = bool(shutter.line_time_s or shutter.std_s)
    params = settings.filter or (PoseFilterParams() if rolls else None)
    before_s = np.nan
    for number, time_s, markers in detected:
        began_s = time.perf_counter()
        if params is not None:
            run = advance(run, time_s, params)
        predicted_s = time.perf_counter()
        predicted = None if params is None else expected(run, params)
        motion = None if predicted is None else _during_frame(predicted, time_s - before_s)
        knows = motion is None and first is not None and first.time_s == time_s
        if first is not None and knows:
            motion = first.motion
        before_s = time_s
        pose = _pose_of_frame(
            markers, marker_map, lens, settings, predicted, motion, shutter if rolls else None
        )
        raw = pose_row(number, time_s, markers, pose, settings)
        raw = _with_common(raw, markers, pose, marker_map, settings.pose, shutter)
        located_s = time.perf_counter()
        row = raw
        if params is not None:
            try:
                run, row = step(run, _with_motion(raw, first.motion) if first and knows else raw, params)
            except np.linalg.LinAlgError:
                # Poses by a wrong map may contradict the motion without any doubt: the filter starts anew.
                run, row = step(advance(FilterRun(), time_s, params), raw, params)
        if settings.filter is None:
            row = raw
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
    predicted: PoseEstimate | None,
    motion: ExpectedMotion | None,
    shutter: RollingShutter | None,
) -> MarkerPose | None:
    """The pose by one frame's markers; the filter's prediction decides between poses that fit about equally well."""
    prior = None
    if predicted is not None and settings.filter is not None:
        prior = ExpectedPose(predicted.position_m, predicted.R_world_cam, predicted.covariance)
    corners_m = marker_map.corners_of(markers.ids.tolist())
    try:
        return estimate_pose(markers.corners_px, corners_m, lens, settings.pose, prior, shutter, motion)
    except np.linalg.LinAlgError:
        # Corners of a wrong map may determine no pose at all; the frame is lost, the others are not.
        return None


def find_first_motion(
    detected: Sequence[tuple[int, float, DetectedMarkers]],
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings,
) -> FirstMotion | None:
    """Find the motion in the first located frame of a recording from this frame and the next ones.

    One frame of a rolling shutter hardly tells a turn from a movement to the side, and no frame before the first one
    tells either.

    Args:
        detected: number and time (seconds) of each frame, and its markers, which are all in the map.
        marker_map: map of the room.
        lens: intrinsics of the camera.
        settings: settings, with the shutter.

    Returns:
        The motion; None for a global shutter, and where the first frames show no motion.
    """
    if settings.shutter is None or not settings.shutter.line_time_s:
        return None
    start = next((k for k, one in enumerate(detected) if len(one[2]) >= settings.pose.min_markers), None)
    if start is None:
        return None
    frames = detected[start : start + _FIRST_FRAMES]
    params = (settings.filter or PoseFilterParams()).within(len(frames))
    raw = join_rows([raw for raw, _ in localise_frames(frames, marker_map, lens, settings)])
    if not raw.seen.any():
        return None
    found = first_estimate(raw, params)
    if found is None or len(frames) < _FEWEST_FIRST:
        return None
    return FirstMotion(found[0], _during_frame(found[1], frames[1][1] - frames[0][1]))


def _during_frame(estimate: PoseEstimate, frame_s: float) -> ExpectedMotion:
    """Motion during a frame; `frame_s` are the seconds since the frame before."""
    # White angular acceleration, averaged over the time between two frames.
    angular_rad_s2 = np.sqrt(estimate.wobble_density_rad2_s3 / frame_s)
    return ExpectedMotion(
        np.concatenate([estimate.velocity_m_s, estimate.rate_rad_s]),
        estimate.motion_covariance,
        np.repeat([estimate.acceleration_m_s2, angular_rad_s2], 3),
    )


def _with_motion(raw: PoseRow, expected: ExpectedMotion) -> PoseRow:
    """The row for the filter, as if the frame's rows showed the expected motion too."""
    seen = raw.motion
    if seen is None:
        return raw
    gain = np.linalg.solve(seen.measured_covariance + expected.covariance, seen.measured_covariance).T
    kept = np.eye(6) - gain
    common = np.concatenate([seen.common[:6], kept @ seen.common[6:]])
    covariance = kept @ seen.measured_covariance @ kept.T + gain @ expected.covariance @ gain.T
    motion = replace(
        seen,
        measured=seen.measured + gain @ (expected.motion - seen.measured),
        measured_covariance=covariance,
        common=common,
    )
    return replace(raw, motion=motion)


def _with_common(
    raw: PoseRow,
    markers: DetectedMarkers,
    pose: MarkerPose | None,
    marker_map: MarkerMap,
    settings: PoseSettings,
    shutter: RollingShutter,
) -> PoseRow:
    """A frame with the change of its pose by each error that is the same in all frames.

    The errors are those of the markers in the map and of the focal length, if any is stated, and of the line time, if
    it is uncertain.
    """
    of_map = 3 * len(marker_map) + 1 if settings.map_error_m or settings.focal_error else 0
    of_shutter = int(shutter.std_s > 0)
    columns = np.zeros(0, int)
    if of_map:
        first = 3 * np.searchsorted(marker_map.ids, markers.ids)
        columns = np.append((first[:, None] + np.arange(3)).ravel(), of_map - 1)

    def placed(effects: Float[np.ndarray, "unknowns errors"]) -> Float[np.ndarray, "unknowns others"]:
        common = np.zeros((len(effects), of_map + of_shutter))
        if of_map:
            common[:, columns] = effects[:, : len(columns)]
        if of_shutter:
            common[:, -1] = effects[:, -1]
        return common

    if pose is None:
        return replace(raw, common=np.zeros((6, of_map + of_shutter)))
    effects = pose.common
    if pose.by_line_time is not None:
        effects = np.concatenate([effects, pose.by_line_time[:, None]], axis=1)
    motion = pose.motion and replace(pose.motion, common=placed(pose.motion.common))
    return replace(raw, common=placed(effects), motion=motion)

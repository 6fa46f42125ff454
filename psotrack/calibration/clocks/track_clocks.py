"""Offsets and drifts of cameras' clocks, from tracks and the places where the cameras show the tracked drones.

The tracks say which sightings are of which drone. The clocks themselves come from the sightings: `camera_clocks`
estimates constant offsets in each of several stretches of the recording, and a straight line through the offsets of
the stretches gives offset and drift. A camera that loses frames runs later from there on: a step, not a drift. Only
differences between cameras show: the median of all offsets, and of all drifts, is 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.clocks.camera_clocks import camera_offsets
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import NEAR_M, Camera, Rig, project
from psotrack.recordings import FrameTimes, Timeline
from psotrack.support import finite_or_none
from psotrack.tracking.camera_errors import ClockStep, find_change, views_of_places
from psotrack.tracking.matching import NOISE_PX, NOISE_SHARE, Sightings
from psotrack.trajectories import Status, Tracks, Trajectories
from psotrack.trajectories.resampling import interpolated

#: Largest error of a clock before the estimate, in intervals between instants: sightings are searched this far along a
#: drone's motion.
MAX_OFFSET_FRAMES = 5.0
#: A sighting whose noise is larger than this multiple of the usual noise is cut by the image's border.
_CUT = 2.0
#: Sightings are interpolated over at most this many intervals of the camera.
_MAX_GAP = 1.6
#: Cells around a sighting's box in which foreground counts: the box has no faint edges.
_MARGIN_CELLS = 3.0
#: Number of instants of silhouettes that are read together.
_CHUNK_FRAMES = 25
#: Least number of instants of a stretch, and largest number of stretches.
_LEAST_INSTANTS, _MOST_STRETCHES = 60, 12
#: What counts only beyond this multiple of its standard deviation: a drift, because over seconds all clocks run alike.
_CLEARLY = 5.0
#: An offset counts only if its standard deviation is below this share of an interval between instants.
_KNOWN = 0.25
#: A step is a whole number of the camera's frames, up to this share of one; and largest number of steps that are found.
_WHOLE, _MOST_STEPS = 0.25, 6


@dataclass(frozen=True)
class LostFrames:
    """Frames that a camera lost: those from some frame on were exposed later than they count.

    Attributes:
        camera: index of the camera.
        frame: its first frame after the lost ones, in its own counting; hovering bodies show it badly.
        count: number of lost frames.
        step_s: their time, seconds.
    """

    camera: int
    frame: int
    count: int
    step_s: float


@dataclass(frozen=True)
class CameraClocks:
    """Estimated corrections of the times of the cameras' frames.

    A frame that was given the time t was exposed at t + offset + drift * (t - middle), where the steps of the frames
    that were lost before it are in t.

    Attributes:
        offset_s: (cameras,), offset in the middle of the recording, seconds; the median is 0. A video that shows the
            scene late has a negative offset. 0 for a camera whose sightings do not show the offset.
        offset_std_s: (cameras,), standard deviations of the offsets, seconds; infinite for a camera that shows nothing.
        drift: (cameras,), seconds per second; 0 where none is certain.
        drift_std: (cameras,), standard deviations of the drifts; infinite where the recording is too short.
        middle_s: time of the middle of the recording, seconds.
        known: (cameras,), whether the sightings show the offset.
        lost: frames that the cameras lost.
    """

    offset_s: Float[np.ndarray, "cameras"]
    offset_std_s: Float[np.ndarray, "cameras"]
    drift: Float[np.ndarray, "cameras"]
    drift_std: Float[np.ndarray, "cameras"]
    middle_s: float
    known: Bool[np.ndarray, "cameras"]
    lost: tuple[LostFrames, ...] = ()

    @property
    def late_s(self) -> Float[np.ndarray, "cameras"]:
        """(cameras,), by how much each video shows the scene late, seconds; negative for a video that is early."""
        return -self.offset_s

    def corrected(
        self, frame_times: Mapping[str, FrameTimes], cameras: Sequence[str]
    ) -> dict[str, FrameTimes]:
        """Frame times with the corrections of these cameras, in the order of the estimate."""
        changed = dict(frame_times)
        for lost in self.lost:
            if (times := changed.get(cameras[lost.camera])) is not None:
                later = np.arange(times.num_frames) >= lost.frame
                changed[cameras[lost.camera]] = FrameTimes.listed(times.time_s + lost.step_s * later)
        for name, offset_s, drift in zip(cameras, self.offset_s.tolist(), self.drift.tolist(), strict=True):
            if name in changed:
                changed[name] = changed[name].corrected(offset_s - drift * self.middle_s, drift)
        return changed

    def record(self, cameras: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Corrections by camera name, fit for JSON; None for a standard deviation that is not known."""
        keys = "offset_s", "late_s", "offset_std_s", "drift", "drift_std"
        found: dict[str, Any] = {
            name: {key: finite_or_none(getattr(self, key)[index]) for key in keys}
            for index, name in enumerate(cameras)
        }
        for lost in self.lost:
            of_camera = found[cameras[lost.camera]].setdefault("lost_frames", [])
            of_camera.append({"before_frame": lost.frame, "count": lost.count})
        return found

    def is_certain(self, least_s: float) -> Bool[np.ndarray, "cameras"]:
        """(cameras,), whether an offset is at least `least_s`, and clearly more than its standard deviation."""
        size_s = np.abs(self.offset_s)
        return (size_s >= least_s) & (size_s > _CLEARLY * self.offset_std_s)


def clocks_of_tracks(
    rig: Rig,
    sightings: Sightings,
    timeline: Timeline,
    tracks: Tracks | Trajectories,
    silhouettes: Silhouettes | None = None,
) -> CameraClocks:
    """Estimate the clocks of the cameras that a recording was tracked with.

    Args:
        rig: the calibrated cameras.
        sightings: sightings at the instants.
        timeline: the instants.
        tracks: tracks with velocities and status at the instants; only positions that were found count.
        silhouettes: silhouettes at the instants, from which the sightings were made; None where a detector made the
            sightings.
    """
    assert tracks.status is not None
    assert tracks.velocity_m_s is not None
    found = (np.asarray(tracks.status) == Status.TRACKED)[..., None]
    position_m, velocity_m_s = (
        np.where(found, values, np.nan).astype(np.float64)
        for values in (tracks.position_m, tracks.velocity_m_s)
    )
    places_px = places_of_tracks(rig.cameras, sightings, timeline, position_m, velocity_m_s, silhouettes)
    lost: list[LostFrames] = []
    while len(lost) < _MOST_STEPS:
        views = views_of_places(rig.cameras, places_px, np.ones(places_px.shape), position_m, velocity_m_s)
        step = find_change(views, views, timeline.rate_hz)
        found = _lost_frames(timeline, step) if isinstance(step, ClockStep) else None
        if step is None or found is None:
            break
        lost.append(found)
        places_px = _as_exposed(places_px, timeline, step.camera, step.frame, found.step_s)
    return replace(estimate_clocks(rig, places_px, timeline), lost=tuple(lost))


def _lost_frames(timeline: Timeline, step: ClockStep) -> LostFrames | None:
    """The frames that were lost in a step; None of a step that is no whole number of frames."""
    ends = np.flatnonzero(timeline.frame[:, step.camera] >= 0)[[0, -1]]
    interval_s = float(np.ptp(timeline.time_s[ends]) / np.ptp(timeline.frame[ends, step.camera]))
    count = round(step.step_s / interval_s)
    if count < 1 or abs(step.step_s / interval_s - count) > _WHOLE:
        return None
    frame = int(timeline.frame[step.frame, step.camera])
    return LostFrames(step.camera, frame, count, count * interval_s)


def places_of_tracks(
    cameras: Camera,
    sightings: Sightings,
    timeline: Timeline,
    position_m: Float[np.ndarray, "instants drones 3"],
    velocity_m_s: Float[np.ndarray, "instants drones 3"],
    silhouettes: Silhouettes | None = None,
) -> Float[np.ndarray, "instants drones cameras 2"]:
    """The place of each drone in each camera, interpolated to the instants on the camera's given clock.

    The place is the middle of a sighting, or of the foreground in the sighting's box. A sighting counts if it is the
    one nearest to the drone's projection, no farther than half its box and the drone's motion in `MAX_OFFSET_FRAMES`
    instants, and no other drone is in its box.

    Args:
        cameras: cameras with one leading axis.
        sightings: sightings at the instants.
        timeline: the instants, and times of the cameras' frames.
        position_m, velocity_m_s: (instants, drones, 3), the tracks, metres and m/s; NaN where a drone is not tracked.
        silhouettes: silhouettes at the instants, from which the sightings were made; None where a detector made the
            sightings.

    Returns:
        (instants, drones, cameras, 2), pixels; NaN where a camera does not show the drone.
    """
    box = np.full((*position_m.shape[:2], len(timeline.cameras)), -1)
    for camera in range(box.shape[2]):
        shown_m = position_m + velocity_m_s * timeline.offset_s[:, camera, None, None]
        reach_m = velocity_m_s * MAX_OFFSET_FRAMES / timeline.rate_hz
        # (instants, drones, 2), and the drone's motion in the image.
        one = cameras[np.array([camera])]
        (middle_px, depth), (moved_px, _) = (
            project(one, np.nan_to_num(at_m)[:, :, None]) for at_m in (shown_m, shown_m + reach_m)
        )
        known = np.isfinite(shown_m).all(axis=-1) & (depth[..., 0] > NEAR_M)
        middle_px = np.where(known[..., None], middle_px[:, :, 0], np.nan)
        flow_px = np.linalg.norm(moved_px[:, :, 0] - middle_px, axis=-1)
        box[:, :, camera] = _own_sightings(sightings, camera, middle_px, flow_px)
    box = np.where((timeline.frame >= 0)[:, None], box, -1)
    places = (
        _middles(sightings.centre_px, box)
        if silhouettes is None
        else _foreground_middles(silhouettes, sightings, box)
    )
    for camera in range(box.shape[2]):
        _interpolate(places[:, :, camera], timeline, camera)
    return places


def _own_sightings(
    sightings: Sightings,
    camera: int,
    middle_px: Float[np.ndarray, "instants drones 2"],
    flow_px: Float[np.ndarray, "instants drones"],
) -> Int[np.ndarray, "instants drones"]:
    """Indices of one camera's sightings that are each drone's alone; -1 where there is none."""
    centre_px, size_px, noise_px = (
        values[:, None, camera] for values in (sightings.centre_px, sightings.size_px, sightings.noise_px)
    )
    off_px = middle_px[:, :, None] - centre_px
    distance_px = np.linalg.norm(off_px, axis=-1)
    side_px = np.sqrt(size_px.prod(axis=-1))
    whole = noise_px < _CUT * (NOISE_PX + NOISE_SHARE * side_px)
    reach_px = size_px.max(axis=-1) / 2 + flow_px[..., None]
    held = (np.abs(off_px) < size_px / 2).all(axis=-1)
    fits = whole & (distance_px <= reach_px) & (held.sum(axis=1, keepdims=True) <= 1)
    distance_px = np.where(fits, distance_px, np.inf)
    box = distance_px.argmin(axis=-1)
    nearest_px = np.take_along_axis(distance_px, box[..., None], axis=-1)[..., 0]
    # A box is the sighting of the drone that is nearest to it.
    of_box_px = np.take_along_axis(distance_px.min(axis=1), box, axis=-1)
    return np.where(np.isfinite(nearest_px) & (nearest_px <= of_box_px), box, -1)


def _middles(
    centre_px: Float[np.ndarray, "instants cameras boxes 2"], box: Int[np.ndarray, "instants drones cameras"]
) -> Float[np.ndarray, "instants drones cameras 2"]:
    """The boxes' values; NaN where there is no box."""
    instant, _, camera = np.indices(box.shape)
    return np.where((box >= 0)[..., None], centre_px[instant, camera, box], np.nan)


def _foreground_middles(
    silhouettes: Silhouettes, sightings: Sightings, box: Int[np.ndarray, "instants drones cameras"]
) -> Float[np.ndarray, "instants drones cameras 2"]:
    """Middles of the foreground in the boxes, which move evenly where edges of boxes move in steps."""
    reduction = silhouettes.reduction
    centre, half = (
        _middles(values, box) / reduction for values in (sightings.centre_px + 0.5, sightings.size_px / 2)
    )
    ends = np.stack([centre - half - _MARGIN_CELLS, centre + half + _MARGIN_CELLS], axis=-2)
    # Boxes may reach beyond the last row or column, but not before the first ones.
    cells = np.maximum(np.rint(np.nan_to_num(ends)), 0.0).astype(int)
    places = np.full(centre.shape, np.nan)
    for first in range(0, silhouettes.num_frames, _CHUNK_FRAMES):
        frames = slice(first, first + _CHUNK_FRAMES)
        for camera, array in enumerate(silhouettes.arrays):
            chunk = np.asarray(array[frames])
            for at, drone in np.argwhere(box[frames, :, camera] >= 0).tolist():
                (x0, y0), (x1, y1) = cells[first + at, drone, camera].tolist()
                shown = cv2.moments(chunk[at, y0:y1, x0:x1])
                if shown["m00"] > 0:
                    x, y = x0 + 0.5 + shown["m10"] / shown["m00"], y0 + 0.5 + shown["m01"] / shown["m00"]
                    places[first + at, drone, camera] = reduction * x - 0.5, reduction * y - 0.5
    return places


def _interpolate(places_px: Float[np.ndarray, "instants drones 2"], timeline: Timeline, camera: int) -> None:
    """Interpolate one camera's places, which are at the times of its frames, to the instants, in place."""
    offset_s, frame = timeline.offset_s[:, camera], timeline.frame[:, camera]
    if not offset_s.any():
        return
    # The first instant of each frame that is shown.
    first = np.flatnonzero((frame >= 0) & (np.diff(frame, prepend=-1) != 0))
    frame_s = (timeline.time_s + offset_s)[first]
    gap_s = _MAX_GAP * float(np.median(np.diff(frame_s))) if len(first) > 1 else 0.0
    places_px[:] = interpolated(frame_s, places_px[first], gap_s)(timeline.time_s)


def estimate_clocks(
    rig: Rig, points_px: Float[np.ndarray, "instants drones cameras 2"], timeline: Timeline
) -> CameraClocks:
    """Estimate offset and drift of each camera's clock from matched sightings.

    Args:
        rig: the calibrated cameras.
        points_px: (instants, drones, cameras, 2), matched sightings at the instants (see `places_of_tracks`).
        timeline: the instants.
    """
    num_stretches = int(np.clip(len(points_px) // _LEAST_INSTANTS, 1, _MOST_STRETCHES))
    parts = np.array_split(np.arange(len(points_px)), num_stretches)
    estimates = [
        camera_offsets(rig, points_px[part], timeline.rate_hz, max_offset_frames=MAX_OFFSET_FRAMES)
        for part in parts
    ]
    offset, std, white, shown = (
        np.array([getattr(one, name) for one in estimates])
        for name in ("offset_frames", "std_frames", "white_std_frames", "shown")
    )
    # One stretch of one camera shows badly how far its errors are correlated: all tell it together.
    larger = np.sqrt(max(float(np.mean((std / white)[shown] ** 2)), 1.0)) if shown.any() else 1.0
    std_s = np.where(shown, larger * (white / timeline.rate_hz), np.inf)
    time_s = np.array([timeline.time_s[part].mean() for part in parts])
    return fit_clocks(time_s, offset / timeline.rate_hz, std_s, known_s=_KNOWN / timeline.rate_hz)


def _as_exposed(
    points_px: Float[np.ndarray, "instants drones cameras 2"],
    timeline: Timeline,
    camera: int,
    instant: int,
    step_s: float,
) -> Float[np.ndarray, "instants drones cameras 2"]:
    """The points at the instants if a camera's frames from an instant on were exposed later."""
    moved_px, time_s = points_px.copy(), timeline.time_s.copy()
    time_s[instant:] += step_s
    # Interpolated over the lost frames, too: a wrong instant must not drop the place that shows that it is wrong.
    at = interpolated(time_s, points_px[:, :, camera], step_s + _MAX_GAP / timeline.rate_hz)
    moved_px[:, :, camera] = at(timeline.time_s)
    return moved_px


def fit_clocks(
    time_s: Float[np.ndarray, "stretches"],
    offset_s: Float[np.ndarray, "stretches cameras"],
    std_s: Float[np.ndarray, "stretches cameras"],
    known_s: float,
) -> CameraClocks:
    """Straight lines through the offsets of stretches of a recording, by weighted least squares.

    The zero of the offsets may differ from stretch to stretch, because a stretch shows differences only.

    Args:
        time_s: (stretches,), middle of each stretch, seconds.
        offset_s, std_s: (stretches, cameras), estimated offsets and their standard deviations, seconds.
        known_s: an offset with a larger standard deviation is not used, seconds.
    """
    num_stretches, num_cameras = offset_s.shape
    middle_s = float(time_s.mean())
    even = np.ones(num_stretches)
    fitted, std = _fit(even[:, None], offset_s, std_s)
    drift, drift_std = np.zeros(num_cameras), np.full(num_cameras, np.inf)
    if num_stretches >= 3:
        line, line_std = _fit(np.stack([even, time_s - middle_s], axis=-1), offset_s, std_s)
        found, drift_std = line[:, 1] - np.median(line[:, 1]), line_std[:, 1]
        if (np.abs(found) > _CLEARLY * drift_std).any():
            drift, fitted, std = found, line, line_std
    seen = np.isfinite(std_s).any(axis=0)
    offset_std_s = np.where(seen, std[:, 0], np.inf)
    known, fitted_s = offset_std_s < known_s, fitted[:, 0]
    zero_s = float(np.median(fitted_s[known])) if known.any() else 0.0
    offset_s = np.where(known, fitted_s - zero_s, 0.0)
    return CameraClocks(offset_s, offset_std_s, np.where(known, drift, 0.0), drift_std, middle_s, known)


def _fit(
    basis: Float[np.ndarray, "stretches terms"],
    offset_s: Float[np.ndarray, "stretches cameras"],
    std_s: Float[np.ndarray, "stretches cameras"],
) -> tuple[Float[np.ndarray, "cameras terms"], Float[np.ndarray, "cameras terms"]]:
    """Coefficients of each camera, relative to the mean of all, and standard deviations, by weighted least squares.

    Where the offsets scatter more than their errors say, the covariance is larger.
    """
    (num_stretches, terms), num_cameras = basis.shape, offset_s.shape[1]
    unknowns = num_cameras * terms
    weight = 1 / np.maximum(std_s, 1e-9).ravel()
    # Rows are those of each camera in one stretch after the other; each stretch has a zero of its own.
    of_cameras = np.einsum("st,cd->scdt", basis, np.eye(num_cameras)).reshape(-1, unknowns)
    zeros = np.repeat(np.eye(num_stretches), num_cameras, axis=0)
    design = weight[:, None] * np.concatenate([of_cameras, zeros], axis=1)
    # A common change of all cameras and all zeros changes nothing: the pseudo-inverse takes the smallest solution.
    inverse = np.linalg.pinv(design)
    solution = inverse @ (weight * offset_s.ravel())
    residual = weight * offset_s.ravel() - design @ solution
    freedom = len(residual) - np.linalg.matrix_rank(design)
    scatter = float(np.sqrt((residual**2).sum() / freedom)) if freedom else 1.0
    covariance = (inverse @ inverse.T)[:unknowns, :unknowns] * max(1.0, scatter) ** 2
    # The coefficients are relative to the cameras' mean, weighted by what is known of them; this mean has no error.
    known = np.square(weight.reshape(offset_s.shape)).sum(axis=0)
    share = known / known.sum() if known.any() else np.full(num_cameras, 1 / num_cameras)
    centred = np.kron(np.eye(num_cameras) - share, np.eye(terms))
    coefficients = solution[:unknowns].reshape(num_cameras, terms)
    std = np.sqrt(np.diag(centred @ covariance @ centred.T)).reshape(num_cameras, terms)
    return coefficients - share @ coefficients, std

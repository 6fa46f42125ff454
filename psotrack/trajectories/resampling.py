"""Trajectories at other times than those at which they were recorded, by interpolation that leaves gaps open; and
orientations as angles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from psotrack.geometry import rotation_matrices as rotation_matrices
from psotrack.trajectories.trajectories import QUANTITIES, Trajectories

_Times = Float[np.ndarray, "times"]
_Samples = Float[np.ndarray, "samples"]
_Frames = Int[np.ndarray, "frames"]
_Instants = Float[np.ndarray, "frames"]
#: Longest gap over which positions are interpolated, seconds; for slow trajectories 1.5 sample intervals.
MAX_GAP_S = 0.1
#: Largest turn between two samples between which orientations are interpolated, radians.
_MOST_TURN = np.deg2rad(150)
#: Times nearer than this are one time, seconds.
_SAME_S = 1e-9

_At = Callable[[_Times], np.ndarray]


def resample(
    trajectories: Trajectories,
    frame: _Frames,
    time_s: _Instants,
    *,
    later_s: float = 0.0,
    gap_s: float | None = None,
) -> Trajectories:
    """Positions and orientations at other times, by cubic splines; NaN outside of the trajectories and in their gaps.

    Orientations are also NaN between samples that are more than 150 degrees apart: which way they turned is not known.

    Args:
        trajectories: trajectories; with a single sample, no position is known.
        frame: (frames,), numbers of the new frames.
        time_s: (frames,), times of the new frames, seconds.
        later_s: the trajectories at time t + `later_s` are the new ones at time t, seconds.
        gap_s: longest gap between samples over which they are interpolated, seconds; None: `longest_gap_s`.
    """
    wanted_s = time_s + later_s
    position_m = interpolated(trajectories.time_s, trajectories.position_m, gap_s)(wanted_s)
    orientation_wxyz = None
    if trajectories.orientation_wxyz is not None:
        longest_s = longest_gap_s(trajectories.time_s) if gap_s is None else gap_s
        turns = [
            _turned(trajectories.time_s, trajectories.orientation_wxyz[:, drone], wanted_s, longest_s)
            for drone in range(trajectories.num_drones)
        ]
        orientation_wxyz = np.stack(turns, axis=1)
    return Trajectories(frame, time_s, trajectories.drones, position_m, orientation_wxyz=orientation_wxyz)


def _turned(
    time_s: _Samples, orientation_wxyz: Float[np.ndarray, "samples 4"], wanted_s: _Times, longest_s: float
) -> Float[np.ndarray, "times 4"]:
    """Orientations of one drone at other times, by a spline through each piece without a gap or a large turn."""
    found = np.full((len(wanted_s), 4), np.nan)
    known = np.flatnonzero(np.isfinite(orientation_wxyz).all(axis=-1))
    if not len(known):
        return found
    sample_s = time_s[known]
    rotation = Rotation.from_quat(orientation_wxyz[known], scalar_first=True)
    turn = (rotation[:-1].inv() * rotation[1:]).magnitude() if len(known) > 1 else np.empty(0)
    ends = np.flatnonzero((np.diff(sample_s) > longest_s) | (turn > _MOST_TURN)) + 1
    for piece in np.split(np.arange(len(known)), ends):
        first_s, last_s = sample_s[piece[0]], sample_s[piece[-1]]
        inside = (wanted_s > first_s - _SAME_S) & (wanted_s < last_s + _SAME_S)
        if inside.any():
            spline = RotationSpline(sample_s[piece], rotation[piece]) if len(piece) > 1 else None
            at_s = np.clip(wanted_s[inside], first_s, last_s)
            turned = spline(at_s) if spline else rotation[np.repeat(piece, len(at_s))]
            found[inside] = turned.as_quat(scalar_first=True)
    return found


def merged(
    parts: Sequence[Trajectories],
    frames: Sequence[Int[np.ndarray, "_"]],
    time_of: Callable[[_Frames], _Instants],
) -> Trajectories:
    """One set of trajectories from those of different drones, in the frames that some of them have; NaN where unknown.

    Args:
        parts: trajectories without status and numbers of cameras.
        frames: for each of them (rows,), the numbers of the new frames of its rows.
        time_of: times of frames, seconds, by their numbers.
    """
    frame = np.unique(np.concatenate(frames)).astype(np.int64)
    drones = tuple(name for part in parts for name in part.drones)
    values = [part.quantities() for part in parts]
    known: dict[str, Any] = {
        name: np.full((len(frame), len(drones), *QUANTITIES[name]), np.nan)
        for each in values
        for name in each
    }
    first = 0
    for part, number, own in zip(parts, frames, values, strict=True):
        rows, stop = np.searchsorted(frame, number), first + part.num_drones
        for name, value in own.items():
            known[name][rows, first:stop] = value
        first = stop
    return Trajectories(frame, time_of(frame).astype(np.float64), drones, **known)


def longest_gap_s(time_s: _Samples) -> float:
    """Longest gap between samples over which positions are interpolated, seconds."""
    return max(MAX_GAP_S, 1.5 * float(np.median(np.diff(time_s)))) if len(time_s) > 1 else MAX_GAP_S


def between_samples(sample_s: _Samples, wanted_s: _Times, longest_s: float) -> Bool[np.ndarray, "times"]:
    """Say which times are at a sample, or between two samples that are at most `longest_s` apart.

    Args:
        sample_s: (samples,), increasing times of at least two samples, seconds.
        wanted_s: (times,), times of interest, seconds.
        longest_s: longest gap between two samples, seconds.
    """
    after = np.clip(np.searchsorted(sample_s, wanted_s), 1, len(sample_s) - 1)
    before_s, after_s = wanted_s - sample_s[after - 1], sample_s[after] - wanted_s
    inside = (np.minimum(before_s, after_s) >= 0) & (before_s + after_s <= longest_s)
    # The samples at both ends of a gap are valid; the tolerance is for rounding errors.
    return inside | (np.minimum(np.abs(before_s), np.abs(after_s)) < _SAME_S)


def interpolated(time_s: _Samples, values: np.ndarray, gap_s: float | None = None) -> _At:
    """A function that interpolates values (samples, drones, ...) by cubic splines.

    It takes times (times,) and returns values (times, drones, ...), NaN outside of the samples and in gaps that are
    longer than `gap_s`, by default `longest_gap_s`.
    """
    flat = values.reshape(*values.shape[:2], -1).astype(np.float64)
    longest_s = longest_gap_s(time_s) if gap_s is None else gap_s
    known = [np.isfinite(flat[:, drone]).all(axis=-1) for drone in range(flat.shape[1])]
    # A spline needs two samples.
    splines = {
        drone: (time_s[there], CubicSpline(time_s[there], flat[there, drone]))
        for drone, there in enumerate(known)
        if there.sum() > 1
    }

    def at(wanted_s: _Times) -> np.ndarray:
        found = np.full((len(wanted_s), *flat.shape[1:]), np.nan)
        for drone, (sample_s, spline) in splines.items():
            inside = between_samples(sample_s, wanted_s, longest_s)
            if inside.any():
                found[inside, drone] = spline(wanted_s[inside])
        return found.reshape(len(wanted_s), *values.shape[1:])

    return at


#: Columns: the axes of a body (x ahead, y left, z up) in the axes of a camera (x right, y down, z ahead).
_BODY_IN_CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def roll_pitch_yaw_deg(
    orientation_wxyz: Float[np.ndarray, "*frames 4"], *, is_camera: bool = True
) -> Float[np.ndarray, "*frames 3"]:
    """Angles of a camera's orientation, as of a body that faces the camera's viewing direction; NaN stays NaN.

    The body's axes are x ahead (the camera's z), y left, z up. It is turned about the world's z by yaw, then about its
    own y by pitch, then about its own x by roll: R = Rz(yaw) Ry(pitch) Rx(roll), as in ROS (REP 103). Yaw is counted
    from the world's x axis, counterclockwise seen from above. Pitch is positive with the nose down, roll with the right
    side down. Each angle is in (-180, 180], pitch in [-90, 90].

    Args:
        orientation_wxyz: (*frames, 4), unit quaternions, camera to world.
        is_camera: whether the axes are those of a camera (x right, y down, z ahead); otherwise those of the body.

    Returns:
        (*frames, 3): roll, pitch, yaw, degrees.
    """
    body = rotation_matrices(orientation_wxyz) @ (_BODY_IN_CAMERA if is_camera else np.eye(3))
    roll = np.arctan2(body[..., 2, 1], body[..., 2, 2])
    pitch = -np.arcsin(np.clip(body[..., 2, 0], -1.0, 1.0))
    yaw = np.arctan2(body[..., 1, 0], body[..., 0, 0])
    return np.degrees(np.stack([roll, pitch, yaw], axis=-1))

"""Clock offsets between a camera's path and a reference: of its positions, and separately of its orientations.

Both use `psotrack.calibration.clocks.find_offset`, first over a wide range and then near the result with all samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation, Slerp

from psotrack.calibration.clocks import Offset, find_offset, time_shift
from psotrack.geometry import rotation_matrices
from psotrack.inside_out.camera_path import CameraPath
from psotrack.trajectories import GATE_M, Status, Trajectories, resampling

#: Function from the offset of the positions' clock to the body's orientations at the samples of its positions,
#: (samples, 4). The offset is None before it is known. The result is None where orientations are not used or unknown.
BodyOrientations = Callable[[float | None], Float[np.ndarray, "samples 4"] | None]

#: Largest distance of the refined offset from the first offset, which a lever arm may have shifted, seconds.
_NEAR_S = 0.5
#: Number of refinements. Each reduces the offset's error to a tenth or less: to the lever arm's motion within it.
_ROUNDS = 3
#: Change of the offset that ends the refinements, seconds; far below the precision of any motion.
_SETTLED_S = 1e-5
#: Number of neighbouring frames whose median position shows jumps.
_NEIGHBOURS = 9
#: Three points stand for the axes of a body: their distance from its origin, which is within the gate of a pairing, and
#: the distance between the three origins, metres.
_OUT_M, _APART_M = 0.1, 10.0


def find_position_offset(
    path: CameraPath,
    time_s: Float[np.ndarray, "samples"],
    position_m: Float[np.ndarray, "samples 3"],
    bodies: BodyOrientations | None,
    *,
    max_offset_s: float | None,
) -> tuple[float, float]:
    """Find the clock offset of a reference's positions, and its standard deviation, seconds.

    Args:
        path: path of the camera.
        time_s, position_m: samples of the reference.
        bodies: orientations of the body, which turn a constant lever arm; None estimates no lever arm. Where the
            function returns None, the orientations of the path turn the arm.
        max_offset_s: see `comparing.compare_paths`.

    Raises:
        SettingsError, InputError: see `psotrack.calibration.clocks.find_offset`.
    """
    path = _without_jumps(path)
    estimate, points_m = path.trajectories("camera"), position_m[:, None]
    middle_s, reach_s = _offset_range(estimate, time_s, points_m, max_offset_s)
    every, body_wxyz = _thin_samples(estimate, time_s), None if bodies is None else bodies(None)
    if bodies is not None and body_wxyz is None:
        # Exchange the roles: shift the reference along the path, whose orientations turn the arm.
        reference = Trajectories(
            np.arange(len(time_s))[every], time_s[every], estimate.drones, points_m[every]
        )
        seen_m = np.where(path.seen[:, None], path.position_m, np.nan)
        start = _find_offset_near(
            reference, path.time_s, seen_m[:, None], path.orientation_wxyz, -middle_s, reach_s
        )
        offset_s = -start.offset_s
    else:
        thin_wxyz = None if body_wxyz is None else body_wxyz[every]
        start = _find_offset_near(
            estimate, time_s[every], points_m[every], thin_wxyz, middle_s, reach_s, bodies is not None
        )
        offset_s = start.offset_s
    found = _refine(estimate, time_s, points_m, bodies, offset_s)
    body_wxyz = None if bodies is None else bodies(found.offset_s)
    if body_wxyz is None:
        return found.offset_s, found.std_s
    arm_m = _axes(body_wxyz).swapaxes(-1, -2) @ found.lever_arm_m[0]
    return found.offset_s, _checked_std_s(estimate, time_s, position_m + arm_m, found.offset_s)


def find_orientation_offset(
    path: CameraPath,
    time_s: Float[np.ndarray, "samples"],
    body_wxyz: Float[np.ndarray, "samples 4"],
    *,
    with_turn: bool,
    max_offset_s: float | None,
) -> float:
    """Find the clock offset of a reference's orientations, seconds, from orientations alone.

    At the right offset, points on the camera's axes are at rest in the body: their lever arms are the columns of the
    constant turn from camera to body. The remaining distances are chords of the remaining angles.

    Args:
        path: path of the camera.
        time_s, body_wxyz: samples of the reference, body to world.
        with_turn: estimate the constant turn; otherwise the camera's axes are the body's.
        max_offset_s: see `comparing.compare_paths`.

    Raises:
        SettingsError, InputError: see `psotrack.calibration.clocks.find_offset`.
    """
    path, middles_m = _without_jumps(path), _APART_M * np.eye(3)
    status = np.repeat(path.status[:, None], 3, axis=1)
    axes_m = middles_m + _OUT_M * _axes(path.orientation_wxyz)
    estimate = Trajectories(path.frame, path.time_s, ("x", "y", "z"), axes_m, status=status)
    known = np.isfinite(body_wxyz).all(axis=-1)[:, None, None]
    points_m = np.where(known, middles_m, np.nan) if with_turn else middles_m + _OUT_M * _axes(body_wxyz)
    turned = body_wxyz if with_turn else None
    middle_s, reach_s = _offset_range(estimate, time_s, points_m, max_offset_s)
    every = _thin_samples(estimate, time_s)
    thin_wxyz = None if turned is None else turned[every]
    start = _find_offset_near(
        estimate, time_s[every], points_m[every], thin_wxyz, middle_s, reach_s, with_turn
    )
    bodies = (lambda offset_s: turned) if with_turn else None
    return _refine(estimate, time_s, points_m, bodies, start.offset_s).offset_s


def interpolate_orientations(
    time_s: Float[np.ndarray, "samples"],
    orientation_wxyz: Float[np.ndarray, "samples 4"],
    wanted_s: Float[np.ndarray, "times"],
) -> Float[np.ndarray, "times 4"]:
    """Orientations between samples, on great arcs, (times, 4); NaN outside, and in gaps too long for positions."""
    found = np.full((len(wanted_s), 4), np.nan)
    known = np.isfinite(orientation_wxyz).all(axis=-1)
    if known.sum() < 2:
        return found
    sample_s = time_s[known]
    arcs = Slerp(sample_s, Rotation.from_quat(orientation_wxyz[known], scalar_first=True))
    inside = resampling.between_samples(sample_s, wanted_s, resampling.longest_gap_s(time_s))
    at_s = np.clip(wanted_s[inside], sample_s[0], sample_s[-1])
    found[inside] = arcs(at_s).as_quat(scalar_first=True)
    return found


def _thin_samples(estimate: Trajectories, time_s: Float[np.ndarray, "samples"]) -> slice:
    """Every n-th sample, about one per frame: a wide search with more samples would not be more precise."""
    step_s, frame_s = (float(np.median(np.diff(times))) for times in (time_s, estimate.time_s))
    return slice(None, None, max(1, round(frame_s / step_s)))


def _refine(
    estimate: Trajectories,
    time_s: Float[np.ndarray, "samples"],
    position_m: Float[np.ndarray, "samples drones 3"],
    bodies: BodyOrientations | None,
    offset_s: float,
) -> Offset:
    """The offset near a first offset, by all samples."""
    reach_s = max(_NEAR_S, 2 * float(np.median(np.diff(time_s))))
    for _ in range(_ROUNDS):
        before_s, body_wxyz = offset_s, None if bodies is None else bodies(offset_s)
        found = _find_offset_near(
            estimate, time_s, position_m, body_wxyz, offset_s, reach_s, bodies is not None
        )
        offset_s = found.offset_s
        if abs(offset_s - before_s) < _SETTLED_S:
            break
    return found


def _checked_std_s(
    estimate: Trajectories,
    time_s: Float[np.ndarray, "samples"],
    camera_m: Float[np.ndarray, "samples 3"],
    offset_s: float,
) -> float:
    """Standard deviation of an offset, by the camera's motion in the reference, with the lever arm.

    Seen from a body that turns, a hovering camera seems to move: `find_offset` alone would count this as motion.
    """
    placed = time_shift.ShiftedPair.of(estimate, time_s, camera_m[:, None], None, with_lever_arm=True)
    std_s = placed.standard_deviation_s(offset_s, np.zeros(1, int))
    frame_s = float(np.median(np.diff(estimate.time_s)))
    if not std_s < frame_s:
        raise time_shift.refused(
            f"motion that determines the offset to a frame, {frame_s:g} s",
            f"a standard deviation of {std_s:.2g} s",
            "drones that hover, or fly straight on at one speed, do not determine it: use more of the recording",
        )
    return std_s


def _find_offset_near(
    estimate: Trajectories,
    time_s: Float[np.ndarray, "samples"],
    position_m: Float[np.ndarray, "samples drones 3"],
    body_wxyz: Float[np.ndarray, "samples 4"] | None,
    middle_s: float,
    reach_s: float,
    with_lever_arm: bool = True,
) -> Offset:
    """`find_offset` with a range about another offset than 0, for drones that all have the same orientation."""
    found = find_offset(
        estimate,
        time_s - middle_s,
        position_m,
        None if body_wxyz is None else np.repeat(body_wxyz[:, None], position_m.shape[1], axis=1),
        max_offset_s=reach_s,
        with_lever_arm=with_lever_arm,
    )
    return replace(found, offset_s=middle_s + found.offset_s)


def _offset_range(
    estimate: Trajectories,
    time_s: Float[np.ndarray, "samples"],
    position_m: Float[np.ndarray, "samples drones 3"],
    max_offset_s: float | None,
) -> tuple[float, float]:
    """Middle and half width of the range of offsets; by default half of the shorter recording always overlaps."""
    if max_offset_s is not None:
        return 0.0, max_offset_s
    spans_s = estimate.time_s[estimate.seen.any(axis=1)], time_s[np.isfinite(position_m).any(axis=(1, 2))]
    if not all(map(len, spans_s)):
        raise time_shift.refused("poses of both", f"{len(spans_s[0])} and {len(spans_s[1])}")
    middles_s = [(span_s[0] + span_s[-1]) / 2 for span_s in spans_s]
    return float(middles_s[1] - middles_s[0]), float(max(map(np.ptp, spans_s)) / 2)


def _without_jumps(path: CameraPath) -> CameraPath:
    """The path without poses far from the poses before and after, which say nothing about time.

    They would move the smallest mean distance little, but would hide how distinct it is.
    """
    seen = np.flatnonzero(path.seen)
    position_m = path.position_m[seen]
    jump_m = np.linalg.norm(position_m - median_filter(position_m, (_NEIGHBOURS, 1), mode="nearest"), axis=-1)
    status = path.status.copy()
    status[seen[jump_m > GATE_M]] = Status.LOST
    return replace(path, status=status)


def _axes(orientation_wxyz: Float[np.ndarray, "times 4"]) -> Float[np.ndarray, "times 3 3"]:
    """The axes of each frame in the world, one per row."""
    return rotation_matrices(orientation_wxyz).swapaxes(-1, -2)

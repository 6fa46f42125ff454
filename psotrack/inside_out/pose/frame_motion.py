"""What one frame of a rolling shutter says about pose and motion, without the motion that was expected."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from psotrack.inside_out.frame_motion import FrameMotion
from psotrack.inside_out.pose.equations import POSE_SIZE, Noise, SeenCorners, Solution, Sums, summed

#: Standard deviations of velocity (m/s) and turn rate (rad/s) that take the place of the expected motion: far above
#: those of a camera, so that the frame alone decides where its rows show the motion.
_ANY_MOTION_STD = np.repeat([50.0, 30.0], 3)


def frame_motion(
    seen: SeenCorners,
    sums: Sums,
    rows: Float[np.ndarray, "markers 4 2 columns"],
    fits: Bool[np.ndarray, "markers 4"],
    noise: Noise,
    extra: Float[np.ndarray, "extra"],
) -> FrameMotion | None:
    """Pose and motion by one frame alone, linearised where a fit ended; None if the equations are singular.

    Args:
        seen: markers of the frame.
        sums: sums of the equations of the fitting corners.
        rows: (markers, 4, 2, unknowns + 1), the equations.
        fits: (markers, 4), True for the fitting corners.
        noise: variances of the errors.
        extra: (8,), inset, focal length and motion of the fit.
    """
    prior = seen.prior_information.copy()
    prior[2:, 2:] = np.diag(_ANY_MOTION_STD**-2.0)
    off_prior = extra - seen.expected_extra
    off_prior[2:] = 0.0
    solution = sums.solved(noise, prior, off_prior)
    if solution is None:
        return None
    whole = np.r_[:POSE_SIZE, POSE_SIZE + 2 : POSE_SIZE + 8]
    effects = unmodelled_effects(seen, rows, fits, noise, prior)
    if effects is None:
        return None
    covariance = (solution.covariance + effects @ effects.T)[np.ix_(whole, whole)]
    by_motion = -np.linalg.solve(covariance[6:, 6:], covariance[6:, :6]).T
    common = sums.common(solution, noise, seen.map_share)[whole]
    if seen.unsure is not None:
        by_line_time = line_time_effects(seen, rows, fits, noise, prior)
        if by_line_time is None:
            return None
        common = np.concatenate([common, (by_line_time[whole] @ extra[2:])[:, None]], axis=1)
    common[:6] += by_motion @ common[6:]
    of_pose = covariance[:6, :6] + by_motion @ covariance[6:, :6]
    of_motion = covariance[6:, 6:]
    if seen.unsure is not None:
        # Errors of the line time are no part of the solution's covariance; those of the map are.
        late = common[:, -1:]
        of_pose, of_motion = of_pose + late[:6] @ late[:6].T, of_motion + late[6:] @ late[6:].T
    return FrameMotion(
        assumed=extra[2:],
        by_motion=by_motion,
        covariance=(of_pose + of_pose.T) / 2,
        measured=extra[2:] + solution.step[POSE_SIZE + 2 :],
        measured_covariance=of_motion,
        common=common,
    )


def line_time_effects(
    seen: SeenCorners,
    rows: Float[np.ndarray, "markers 4 2 columns"],
    fits: Bool[np.ndarray, "markers 4"],
    noise: Noise,
    prior_information: Float[np.ndarray, "extra extra"],
) -> Float[np.ndarray, "unknowns 6"] | None:
    """Change of the unknowns by an error of the line time of one standard deviation, for each part of the motion.

    Rows that were exposed later than assumed show the camera where its motion took it meanwhile, which changes the
    pixels as a change of the pose does. None if the equations are singular.
    """
    if seen.unsure is None:
        return np.zeros((rows.shape[-1] - 1, 6))
    off_px = seen.unsure.error_s[..., None, None] * rows[..., :POSE_SIZE]
    return _effects(seen, rows, fits, noise, prior_information, off_px)


def unmodelled_effects(
    seen: SeenCorners,
    rows: Float[np.ndarray, "markers 4 2 columns"],
    fits: Bool[np.ndarray, "markers 4"],
    noise: Noise,
    prior_information: Float[np.ndarray, "extra extra"],
) -> Float[np.ndarray, "unknowns causes"] | None:
    """Change of the unknowns by one standard deviation of each cause of errors that the equations do not have.

    The causes are a shift of all corners along x and along y of the image, and of a rolling shutter the acceleration
    along and about each axis: in the time s before and after the reference row, an acceleration a takes the camera
    a s² / 2 away from where a constant motion takes it. None if the equations are singular.
    """
    return _effects(seen, rows, fits, noise, prior_information, _unmodelled_px(seen, rows))


def unmodelled_residuals(
    seen: SeenCorners,
    rows: Float[np.ndarray, "markers 4 2 columns"],
    effects: Float[np.ndarray, "unknowns causes"],
) -> Float[np.ndarray, "markers 4 2 causes"]:
    """Residuals that one standard deviation of each such cause leaves, with its effects on the unknowns."""
    return _unmodelled_px(seen, rows) - rows[..., :-1] @ effects


def _unmodelled_px(
    seen: SeenCorners, rows: Float[np.ndarray, "markers 4 2 columns"]
) -> Float[np.ndarray, "markers 4 2 causes"]:
    """Changes of the pixels by one standard deviation of each such cause."""
    shifts = np.broadcast_to(seen.shift_px * np.eye(2), (*rows.shape[:3], 2))
    if seen.rows is None:
        return shifts
    # The derivatives by the motion are s times those by the pose.
    by_motion = rows[..., POSE_SIZE + 2 : POSE_SIZE + 8]
    by_acceleration = seen.rows.time_s[..., None, None] / 2 * by_motion * seen.rows.acceleration_std
    return np.concatenate([shifts, by_acceleration], axis=-1)


def _effects(
    seen: SeenCorners,
    rows: Float[np.ndarray, "markers 4 2 columns"],
    fits: Bool[np.ndarray, "markers 4"],
    noise: Noise,
    prior_information: Float[np.ndarray, "extra extra"],
    off_px: Float[np.ndarray, "markers 4 2 errors"],
) -> Float[np.ndarray, "unknowns errors"] | None:
    """Change of the unknowns by changes of the pixels; None if the equations are singular."""
    none, moved = np.zeros(len(prior_information)), rows.copy()
    effects = np.zeros((rows.shape[-1] - 1, off_px.shape[-1]))
    for error in np.flatnonzero(off_px.any(axis=(0, 1, 2))):
        moved[..., -1] = off_px[..., error]
        solution: Solution | None = summed(moved, fits, seen.centre_scale).solved(
            noise, prior_information, none
        )
        if solution is None:
            return None
        effects[:, error] = solution.step
    return effects

"""Significance of a bundle adjustment: which cameras moved by more than the errors explain, and which should stay.

Let x be the changes of all cameras' poses, Λ the information of x, and b = Λ x. If only the cameras of a set S move,
the cost falls by b_Sᵀ Λ_SS⁻¹ b_S (the gain of S). If the rig is correct, one more camera in S raises the gain by a χ²
variable of six degrees of freedom. Cameras are added to S one by one, the camera of largest gain first (forward
selection), so that a camera that was pushed does not make the correct cameras look wrong. The selection ends when
neither one more camera nor all other cameras together gain more than chance explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from psotrack.calibration.bundle import AdjustedRig, adjust
from psotrack.calibration.common_errors import CommonErrors
from psotrack.calibration.gauge import common_motions, pose_change_metric, pose_changes
from psotrack.errors import InputError
from psotrack.geometry import Rig

#: Largest probability that a camera of a correct rig is called wrong.
FALSE_ALARM = 0.01
#: Largest share of wrong cameras: if more cameras are wrong, too few correct cameras remain as a reference.
MOST_OFF = 0.5
#: A wrong focal length looks like a shift along the optical axis. The focal length may be wrong instead of the pose if
#: the median residual with another focal length is at most this multiple of the median residual with another pose. If
#: the camera was turned, or moved in another direction, the median residual with another focal length is much larger.
AS_WELL = 1.2


@dataclass(frozen=True)
class Improved:
    """A rig in which only cameras that are certainly wrong were changed.

    Attributes:
        rig: the improved rig; the given rig if no camera is wrong.
        moved: names of the cameras that were moved.
        zoomed: cameras that were moved, but may have another focal length instead: by name, the factor of the focal
            length and its standard deviation.
        rescaled: whether all focal lengths were multiplied with a common factor.
        everything: the adjustment in which all cameras that are not fixed may move.
        final: the adjustment in which correct cameras are fixed; None if nothing was changed.
        centre_covariance_m2: (cameras, 3, 3), covariances of the centres in the world, square metres: for moved
            cameras from `final`, for others from `everything`.
    """

    rig: Rig
    moved: tuple[str, ...]
    zoomed: dict[str, tuple[float, float]]
    rescaled: bool
    everything: AdjustedRig
    final: AdjustedRig | None
    centre_covariance_m2: Float[np.ndarray, "cameras 3 3"]


def improve(
    rig: Rig,
    points_px: Float[np.ndarray, "points cameras 2"],
    noise_px: float | Float[np.ndarray, "points cameras"] = 1.0,
    *,
    fixed: Sequence[str] = (),
    refine_focal_length: bool = False,
    common_errors: Sequence[CommonErrors] = (),
    suspects: Sequence[str] | None = None,
) -> Improved:
    """Adjust only the cameras that are wrong by more than errors in the images explain.

    Args:
        rig: see `bundle.adjust`.
        points_px: see `bundle.adjust`.
        noise_px: see `bundle.adjust`.
        fixed: see `bundle.adjust`.
        common_errors: see `bundle.adjust`.
        suspects: names of the cameras that may be found wrong; None: all that are not fixed. The others may move in
            `everything`, which tells how well they are known.
        refine_focal_length: multiply all focal lengths with a common factor if this factor certainly differs from 1.

    Raises:
        SettingsError, InputError: see `bundle.adjust`.
    """
    every = rig.names if refine_focal_length else ()
    everything = adjust(rig, points_px, noise_px, fixed=fixed, rescaled=every, common_errors=common_errors)
    rescaled = bool(_surprise(everything) > chi2.isf(FALSE_ALARM, 1))
    moved = find_wrong_cameras(rig, everything, fixed)
    if suspects is not None:
        moved = tuple(name for name in moved if name in suspects)
    if not moved and not rescaled:
        return Improved(rig, (), {}, False, everything, None, everything.centre_covariance_m2)
    stay = [name for name in rig.names if name not in moved]
    final = everything
    if set(stay) != set(fixed) or rescaled != refine_focal_length:
        every = rig.names if rescaled else ()
        final = adjust(rig, points_px, noise_px, fixed=stay, rescaled=every, common_errors=common_errors)
    zoomed = {} if rescaled else _zoomed(rig, points_px, noise_px, common_errors, final, moved)
    covariance_m2 = everything.centre_covariance_m2.copy()
    for index, name in enumerate(rig.names):
        if name in moved:
            covariance_m2[index] = final.centre_covariance_m2[index]
        if name in zoomed:
            # The camera's old and new position are equally likely.
            shift_m = final.rig.cameras.centre_world[index] - rig.cameras.centre_world[index]
            covariance_m2[index] += np.outer(shift_m, shift_m) / 2
    return Improved(final.rig, moved, zoomed, rescaled, everything, final, covariance_m2)


def _surprise(adjusted: AdjustedRig) -> float:
    """Squared deviation of the focal lengths' factor from 1, in squared standard deviations; 0 for fixed lengths."""
    std = adjusted.focal_scale_std / adjusted.focal_scale
    return float((np.log(adjusted.focal_scale) / std) ** 2) if std > 0 else 0.0


def _zoomed(
    rig: Rig,
    points_px: Float[np.ndarray, "points cameras 2"],
    noise_px: float | Float[np.ndarray, "points cameras"],
    common_errors: Sequence[CommonErrors],
    final: AdjustedRig,
    moved: tuple[str, ...],
) -> dict[str, tuple[float, float]]:
    """Find moved cameras whose sightings fit as well with the old pose and another focal length."""
    if len(moved) > MOST_OFF * len(rig):
        return {}
    found = {}
    for name in moved:
        index = rig.names.index(name)
        hidden = np.array([other in moved and other != name for other in rig.names])
        seen_px = np.where(hidden[:, None], np.nan, points_px)
        try:
            lens = adjust(
                rig, seen_px, noise_px, fixed=rig.names, rescaled=(name,), common_errors=common_errors
            )
        except InputError:
            # No focal length makes this camera's sightings agree with the other cameras.
            continue
        by_lens, by_pose = (np.nanmedian(adjusted.residual_px[:, index]) for adjusted in (lens, final))
        if by_lens < AS_WELL * by_pose:
            found[name] = lens.focal_scale, lens.focal_scale_std
    return found


def find_wrong_cameras(rig: Rig, adjusted: AdjustedRig, fixed: Sequence[str] = ()) -> tuple[str, ...]:
    """Names of the cameras that are wrong by more than the covariance explains.

    If more than `MOST_OFF` of the cameras are wrong, all cameras that are not fixed are returned.

    Args:
        rig: the rig before the adjustment.
        adjusted: the adjustment of this rig, with the same fixed cameras.
        fixed: names of the cameras that do not move.
    """
    may_move = [index for index, name in enumerate(rig.names) if name not in fixed]
    information, pull = _information(rig, adjusted, fixed)
    off: list[int] = []
    least = float(chi2.isf(FALSE_ALARM / max(len(may_move), 1), 6))
    candidates = list(range(len(may_move)))
    freedom = 6 * len(may_move) - (7 if len(may_move) == len(rig) else 0)
    gained, most = 0.0, _gain(information, pull, candidates) if candidates else 0.0
    while len(off) < len(may_move):
        if len(off) > MOST_OFF * len(rig):
            return tuple(rig.names[index] for index in may_move)
        gains = {index: _gain(information, pull, [*off, index]) for index in candidates if index not in off}
        best = max(gains, key=lambda index: gains[index])
        # The errors of several cameras may be significant together although no single one is.
        left = freedom - 6 * len(off)
        if gains[best] - gained < least and (left < 1 or most - gained < chi2.isf(FALSE_ALARM, left)):
            break
        off, gained = [*off, best], gains[best]
    return tuple(rig.names[may_move[index]] for index in sorted(off))


def _information(
    rig: Rig, adjusted: AdjustedRig, fixed: Sequence[str]
) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
    """Information Λ of the changes x of the cameras that may move, without common motions; and b = Λ x."""
    given = np.asarray(rig.cameras.T_cam_world)
    rows = np.flatnonzero(np.repeat([name not in fixed for name in rig.names], 6))
    inverse = np.linalg.inv(adjusted.joint_covariance[np.ix_(rows, rows)])
    if len(rows) == 6 * len(rig):
        motions = common_motions(given)
        held = (motions.T @ pose_change_metric(given))[:, rows]
        motions = motions[rows]
        within = np.eye(len(rows)) - motions @ np.linalg.solve(held @ motions, held)
        inverse = within.T @ inverse @ within
    return inverse, inverse @ pose_changes(given, np.asarray(adjusted.rig.cameras.T_cam_world))[rows]


def _gain(
    information: Float[np.ndarray, "unknowns unknowns"],
    pull: Float[np.ndarray, " unknowns"],
    moved: list[int],
) -> float:
    """Decrease of the cost if only the given cameras move."""
    rows = np.concatenate([np.arange(6 * index, 6 * index + 6) for index in moved])
    return float(pull[rows] @ np.linalg.lstsq(information[np.ix_(rows, rows)], pull[rows], rcond=None)[0])

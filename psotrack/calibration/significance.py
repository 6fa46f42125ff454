"""Significance of a bundle adjustment: which cameras moved by more than the errors explain, and which should stay.

A change of camera i alone, all others standing still, is judged by how much better the rig then agrees: with x the
changes of all cameras' poses, Λ its information, b = Λ x, and S some cameras, b_Sᵀ Λ_SS⁻¹ b_S is what moving just those
gains, and one camera more gains χ² of six degrees of freedom by chance. Cameras are taken one after the other, that
which gains most first (forward selection), so that one that was pushed does not drag the others along, until neither
one more nor all that are left together gain more than chance.
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
#: If more than this share of the cameras is wrong, too few cameras remain as a reference.
MOST_OFF = 0.5
#: A wrong focal length looks like a shift along the optical axis. The focal length may be wrong if its median residual
#: is at most this multiple of the pose's: for a camera that was turned or moved otherwise, it is much larger.
AS_WELL = 1.2


@dataclass(frozen=True)
class Improved:
    """A rig in which only those cameras are changed that are wrong for certain.

    Attributes:
        rig: the improved rig; the given rig if no camera is wrong.
        moved: names of the cameras that were moved.
        zoomed: cameras that were moved, but may have another focal length instead: by name, the factor of the focal
            length and its standard deviation.
        rescaled: whether all focal lengths were multiplied with a common factor.
        everything: the adjustment in which all cameras may move that are not fixed.
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
) -> Improved:
    """Adjust only those cameras that are wrong by more than errors in the images explain.

    Arguments and errors are those of `bundle.adjust`, and in addition:

    Args:
        refine_focal_length: multiply all focal lengths with a common factor if this factor differs from 1 for certain.
    """
    every = rig.names if refine_focal_length else ()
    everything = adjust(rig, points_px, noise_px, fixed=fixed, rescaled=every, common_errors=common_errors)
    rescaled = bool(_surprise(everything) > chi2.isf(FALSE_ALARM, 1))
    moved = find_wrong_cameras(rig, everything, fixed)
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
        hidden = np.array([one in moved and one != name for one in rig.names])
        seen_px = np.where(hidden[:, None], np.nan, points_px)
        try:
            lens = adjust(
                rig, seen_px, noise_px, fixed=rig.names, rescaled=(name,), common_errors=common_errors
            )
        except InputError:
            # No focal length makes this camera's sightings agree with the other cameras.
            continue
        by_lens, by_pose = (np.nanmedian(one.residual_px[:, index]) for one in (lens, final))
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
    everyone = list(range(len(may_move)))
    freedom = 6 * len(may_move) - (7 if len(may_move) == len(rig) else 0)
    gained, most = 0.0, _gain(information, pull, everyone) if everyone else 0.0
    while len(off) < len(may_move):
        if len(off) > MOST_OFF * len(rig):
            return tuple(rig.names[index] for index in may_move)
        gains = {one: _gain(information, pull, [*off, one]) for one in everyone if one not in off}
        best = max(gains, key=lambda one: gains[one])
        # Many cameras can each be wrong by too little to be found, and together by too much.
        left = freedom - 6 * len(off)
        if gains[best] - gained < least and (left < 1 or most - gained < chi2.isf(FALSE_ALARM, left)):
            break
        off, gained = [*off, best], gains[best]
    return tuple(rig.names[may_move[one]] for one in sorted(off))


def _information(
    rig: Rig, adjusted: AdjustedRig, fixed: Sequence[str]
) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
    """Λ of the cameras that may move, which does not depend on common motions, and b = Λ x."""
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
    rows = np.concatenate([np.arange(6 * one, 6 * one + 6) for one in moved])
    return float(pull[rows] @ np.linalg.lstsq(information[np.ix_(rows, rows)], pull[rows], rcond=None)[0])

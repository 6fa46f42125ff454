"""Which cameras a bundle adjustment moved by more than it can know, and which had better stay where they are.

A change of camera i alone, all others standing still, is judged by how much better the rig then agrees: with x the
departure of all cameras, Λ its information, b = Λ x, and S some cameras, b_Sᵀ Λ_SS⁻¹ b_S is what moving just those
gains, and one camera more gains χ² of six degrees of freedom by chance. Cameras are taken one after the other, that
which gains most first (forward selection), so that one that was pushed does not drag the others along, until neither
one more nor all that are left together gain more than chance.
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from psotrack.calibration.alike import Alike
from psotrack.calibration.bundle import AdjustedRig, adjust
from psotrack.calibration.gauge import common_motions, departure, metric
from psotrack.errors import InputError
from psotrack.geometry import CameraRig

#: Probability, at most, that a camera of a right rig is called off.
FALSE_ALARM = 0.01
#: If more than this share of the cameras is off there is nothing left to hold the others by.
MOST_OFF = 0.5
#: A focal length looks much like a place along the optical axis: where residuals are no larger than so many times those
#: of the pose it may be what is off. Those of a camera that was turned or moved otherwise are larger by far.
AS_WELL = 1.2


@dataclass(frozen=True)
class Improved:
    """A rig in which nothing is changed but what is off for certain.

    Attributes:
        rig: the one that was given where nothing is off.
        moved: names of the cameras that were moved.
        zoomed: of cameras that were moved, but may have another focal length instead: the factor that it would be
            multiplied with, and its standard deviation.
        rescaled: whether all focal lengths were.
        everything: the adjustment with all free that may move: what the points can tell.
        final: the one with the cameras that agree fixed; None where nothing is changed.
        centre_covariance_m2: (cameras, 3, 3), world, m²: of what was moved as it is now, of the others how well the
            points know them.
    """

    rig: CameraRig
    moved: tuple[str, ...]
    zoomed: dict[str, tuple[float, float]]
    rescaled: bool
    everything: AdjustedRig
    final: AdjustedRig | None
    centre_covariance_m2: Float[np.ndarray, "cameras 3 3"]


def improve(
    rig: CameraRig,
    points_px: Float[np.ndarray, "points cameras 2"],
    noise_px: float | Float[np.ndarray, "points cameras"] = 1.0,
    *,
    fixed: Ordered[str] = (),
    refine_focal_length: bool = False,
    alike: Ordered[Alike] = (),
) -> Improved:
    """A bundle adjustment of the cameras that are off by more than errors in the images explain, and of no others.

    Arguments and errors are those of `bundle.adjust`, but for:

    Args:
        refine_focal_length: multiply all focal lengths with a common factor, if that is off for certain.
    """
    every = rig.names if refine_focal_length else ()
    everything = adjust(rig, points_px, noise_px, fixed=fixed, rescaled=every, alike=alike)
    rescaled = bool(_surprise(everything) > chi2.isf(FALSE_ALARM, 1))
    moved = off_cameras(rig, everything, fixed)
    if not moved and not rescaled:
        return Improved(rig, (), {}, False, everything, None, everything.centre_covariance_m2)
    stay = [name for name in rig.names if name not in moved]
    final = everything
    if set(stay) != set(fixed) or rescaled != refine_focal_length:
        every = rig.names if rescaled else ()
        final = adjust(rig, points_px, noise_px, fixed=stay, rescaled=every, alike=alike)
    zoomed = {} if rescaled else _zoomed(rig, points_px, noise_px, alike, final, moved)
    covariance_m2 = everything.centre_covariance_m2.copy()
    for index, name in enumerate(rig.names):
        if name in moved:
            covariance_m2[index] = final.centre_covariance_m2[index]
        if name in zoomed:
            # It is here, or where it was: as likely the one as the other.
            shift_m = final.rig.cameras.centre_world[index] - rig.cameras.centre_world[index]
            covariance_m2[index] += np.outer(shift_m, shift_m) / 2
    return Improved(final.rig, moved, zoomed, rescaled, everything, final, covariance_m2)


def _surprise(adjusted: AdjustedRig) -> float:
    """χ² of one degree of freedom, of the focal lengths' factor; 0 where they are fixed."""
    std = adjusted.focal_scale_std / adjusted.focal_scale
    return float((np.log(adjusted.focal_scale) / std) ** 2) if std > 0 else 0.0


def _zoomed(
    rig: CameraRig,
    points_px: Float[np.ndarray, "points cameras 2"],
    noise_px: float | Float[np.ndarray, "points cameras"],
    alike: Ordered[Alike],
    final: AdjustedRig,
    moved: tuple[str, ...],
) -> dict[str, tuple[float, float]]:
    """Cameras whose views another focal length, where they stood, fits as well as another pose."""
    if len(moved) > MOST_OFF * len(rig):
        return {}
    found = {}
    for name in moved:
        index = rig.names.index(name)
        hidden = np.array([one in moved and one != name for one in rig.names])
        seen_px = np.where(hidden[:, None], np.nan, points_px)
        try:
            lens = adjust(rig, seen_px, noise_px, fixed=rig.names, rescaled=(name,), alike=alike)
        except InputError:
            continue  # with no focal length do its views agree with those of the others
        by_lens, by_pose = (np.nanmedian(one.residual_px[:, index]) for one in (lens, final))
        if by_lens < AS_WELL * by_pose:
            found[name] = lens.focal_scale, lens.focal_scale_std
    return found


def off_cameras(rig: CameraRig, adjusted: AdjustedRig, fixed: Ordered[str] = ()) -> tuple[str, ...]:
    """Names of the cameras that are off by more than the covariance explains; all that may move if most of them are.

    Args:
        rig: as it was.
        adjusted: from it, with those cameras fixed.
        fixed: names of cameras that stay in any case.
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
        # Many cameras may each be off by too little to be told, and by too much all together.
        left = freedom - 6 * len(off)
        if gains[best] - gained < least and (left < 1 or most - gained < chi2.isf(FALSE_ALARM, left)):
            break
        off, gained = [*off, best], gains[best]
    return tuple(rig.names[may_move[one]] for one in sorted(off))


def _information(
    rig: CameraRig, adjusted: AdjustedRig, fixed: Ordered[str]
) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
    """Λ of the cameras that may move, whatever common motion is added to them, and b = Λ x."""
    given = np.asarray(rig.cameras.T_cam_world)
    rows = np.flatnonzero(np.repeat([name not in fixed for name in rig.names], 6))
    inverse = np.linalg.inv(adjusted.joint_covariance[np.ix_(rows, rows)])
    if len(rows) == 6 * len(rig):
        motions = common_motions(given)
        held = (motions.T @ metric(given))[:, rows]
        motions = motions[rows]
        within = np.eye(len(rows)) - motions @ np.linalg.solve(held @ motions, held)
        inverse = within.T @ inverse @ within
    return inverse, inverse @ departure(given, np.asarray(adjusted.rig.cameras.T_cam_world))[rows]


def _gain(
    information: Float[np.ndarray, "unknowns unknowns"],
    pull: Float[np.ndarray, " unknowns"],
    moved: list[int],
) -> float:
    rows = np.concatenate([np.arange(6 * one, 6 * one + 6) for one in moved])
    return float(pull[rows] @ np.linalg.lstsq(information[np.ix_(rows, rows)], pull[rows], rcond=None)[0])

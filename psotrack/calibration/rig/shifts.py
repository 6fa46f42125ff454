"""Cameras whose frames are counted wrongly: their sightings fit what the other cameras see at other instants.

What moves is elsewhere at another instant, so a camera whose frames are counted wrongly has no pose that fits. It is
placed by its slowest sightings then, and the rest are left out as if they were of something else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.pnp import solve_pnp_ransac
from psotrack.calibration.rig.adjustment import CalibratedRig
from psotrack.calibration.rig.moving_point import PointViews
from psotrack.geometry import Rig, project, triangulate_linearly, undistort

#: Largest shift that is looked for, instants: two seconds of 30 per second.
_MOST_SHIFT = 60
#: Distance in the image up to which a moving point's sighting fits, pixels: ten times the error of a usual detector;
#: and that of a board's corner: a camera that is counted wrongly pulls the boards by some pixels.
_FITS_PX, _CORNER_FITS_PX = 5.0, 2.0
#: A camera of whose sightings a larger fraction fits is sound.
_SOUND = 0.6
#: Least gain of the fraction that fits to tell a shift; clutter fits a few more sightings at any shift.
_LEAST_GAIN = 0.2
#: Smallest and largest number of sightings that are compared.
_LEAST, _MOST = 24, 300


@dataclass(frozen=True)
class Shift:
    """A camera whose sightings fit the others better at other instants.

    Attributes:
        camera: name of the camera.
        instants: its sightings of an instant fit the others at this many instants later.
        fits: fraction of its sightings that fit as they are counted.
        shifted_fits: fraction that fits with the shift.
    """

    camera: str
    instants: int
    fits: float
    shifted_fits: float

    def __str__(self) -> str:
        early, add, to = ("early", "add", "to") if self.instants > 0 else ("late", "subtract", "from")
        count = abs(self.instants)
        return (
            f"{self.camera} shows the scene {early} by about {count} instants: {self.shifted_fits:.0%} of its "
            f"sightings fit the other cameras then, {self.fits:.0%} as its frames are counted; "
            f"{add} {count} instants {to} its time_offset_s in a recording.toml, or check its frame numbers, and run "
            "again"
        )


def find_point_shifts(rig: Rig, views: PointViews) -> list[Shift]:
    """Cameras whose sightings of a moving point fit the others much better if their instants are counted otherwise.

    Args:
        rig: the rig that was found from the sightings.
        views: all sightings, of which instants follow each other at one rate.
    """
    key, shifts = 2 * views.number + views.point, []
    for index in range(len(rig) if len(rig) > 2 else 0):
        # Positions of the point by the other cameras, where these agree.
        others_px = views.points_px.copy()
        others_px[:, index] = np.nan
        points_m = triangulate_linearly(rig.cameras, others_px)
        distance_px = np.linalg.norm(project(rig.cameras, points_m[:, None])[0] - others_px, axis=-1)
        disagree = np.any(distance_px > _FITS_PX, axis=1)
        points_m = np.where(disagree[:, None], np.nan, points_m)
        shifts += _shift(rig, index, key, views.points_px[:, index], points_m, 2, _FITS_PX)
    return shifts


def find_board_shifts(calibrated: CalibratedRig) -> list[Shift]:
    """The same for cameras that see a board: the board is where the other cameras have it."""
    views, rig, shifts, corners_m = calibrated.views, calibrated.rig, [], calibrated.board.corners_m
    key = (views.number[:, None] * len(corners_m) + np.arange(len(corners_m))).ravel()
    T = calibrated.T_world_board
    points_m = np.einsum("vij,nj->vni", T[:, :3, :3], corners_m) + T[:, None, :3, 3]
    for index in range(len(rig)):
        known = np.any(np.delete(calibrated.used, index, axis=0), axis=(0, 2))
        known_m = np.where(known[:, None, None], points_m, np.nan).reshape(-1, 3)
        corners_px = views.corners_px[index].reshape(-1, 2)
        shifts += _shift(rig, index, key, corners_px, known_m, len(corners_m), _CORNER_FITS_PX)
    return shifts


def _shift(
    rig: Rig,
    index: int,
    key: Int[np.ndarray, " points"],
    points_px: Float[np.ndarray, "points 2"],
    points_m: Float[np.ndarray, "points 3"],
    per_instant: int,
    gate_px: float,
) -> list[Shift]:
    """The shift of a camera, if it has one; the camera is placed anew for each shift.

    Args:
        rig: the cameras.
        index: index of the camera.
        key: numbers of points, `per_instant` of them for each instant.
        points_px: the camera's pixels of the points; NaN where it does not see one.
        points_m: their positions by the other cameras; NaN where they do not know one.
        per_instant: how many numbers an instant has.
        gate_px: largest distance of a sighting from its point's projection, pixels.
    """
    gate = gate_px / float(rig.cameras.K[index, 0, 0])
    rays, known = undistort(rig.cameras[index], points_px), np.isfinite(points_m[:, 0])
    is_seen = np.isfinite(rays[:, 0])
    rays, known_m = rays[is_seen], points_m[known]
    fractions: dict[int, float] = {}
    least = _LEAST
    for shift in sorted(range(-_MOST_SHIFT, _MOST_SHIFT + 1), key=abs):
        _, here, there = np.intersect1d(key[is_seen] + shift * per_instant, key[known], return_indices=True)
        if len(here) >= least:
            some = np.linspace(0, len(here) - 1, min(len(here), _MOST)).astype(np.int64)
            found = solve_pnp_ransac(known_m[there[some]], rays[here[some]], gate)
            fractions[shift] = 0.0 if found is None else float(found[1].mean())
        if shift == 0:
            if fractions.get(0, 1.0) >= _SOUND:
                return []
            # The sightings of one instant or two, of a long shift, fit some pose in any case.
            least = max(_LEAST, len(here) // 2)
    best = max(fractions, key=lambda shift: fractions[shift])
    gain = fractions[best] - fractions[0]
    return [Shift(rig.names[index], best, fractions[0], fractions[best])] if gain > _LEAST_GAIN else []

"""Cameras whose frames are counted wrongly: their sightings of a moving point fit the other cameras at other instants.

A point that moves is elsewhere at another instant, so a camera whose frames are counted wrongly has no pose that fits.
It is placed by its slowest sightings then, and the rest are left out as if they were of something else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.calibration.pnp import solve_pnp_ransac
from psotrack.calibration.rig.moving_point import PointViews
from psotrack.geometry import Rig, project, triangulate_linearly, undistort

#: Largest shift that is looked for, instants: two seconds of 30 per second.
_MOST_SHIFT = 60
#: Distance in the image up to which a sighting fits, pixels: ten times the error of a usual detector.
_FITS_PX = 5.0
#: A camera of whose sightings a larger fraction fits is sound.
_SOUND = 0.6
#: Least gain of the fraction that fits to tell a shift; clutter fits a few more sightings at any shift.
_LEAST_GAIN = 0.2
#: Smallest and largest number of sightings that are compared.
_LEAST, _MOST = 24, 300


@dataclass(frozen=True)
class PointShift:
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
            f"{add} {count} instants {to} its time_offset_s, or check its frame numbers, and run again"
        )


def find_point_shifts(rig: Rig, views: PointViews) -> list[PointShift]:
    """Cameras whose sightings fit the other cameras much better if their instants are counted otherwise.

    Shifts of up to 60 instants are tried. Each camera is placed anew for each shift, by the positions of the point that
    at least two other cameras agree on.

    Args:
        rig: the rig that was found from the sightings.
        views: all sightings, of which instants follow each other at one rate.
    """
    shifts = []
    for index, name in enumerate(views.names if len(views.names) > 2 else ()):
        fractions = _fractions(rig, views, index)
        best = max(fractions, key=lambda shift: fractions[shift], default=0)
        fraction = fractions.get(0, 1.0)
        if fraction < _SOUND and fractions.get(best, 0.0) > fraction + _LEAST_GAIN:
            shifts.append(PointShift(name, best, fraction, fractions[best]))
    return shifts


def _fractions(rig: Rig, views: PointViews, index: int) -> dict[int, float]:
    """Fraction of a camera's sightings that one pose fits, by shift; only the shift 0 if the camera is sound."""
    points_m = _points_of_others(rig, views, index)
    known = {
        (int(number), int(point)): row
        for row, (number, point) in enumerate(zip(views.number, views.point, strict=True))
        if np.isfinite(points_m[row, 0])
    }
    rays = undistort(rig.cameras[index], views.points_px[:, index])
    seen = np.flatnonzero(np.isfinite(rays[:, 0]))
    gate = _FITS_PX / float(np.asarray(rig.cameras.K)[index, 0, 0])
    fractions: dict[int, float] = {}
    for shift in sorted(range(-_MOST_SHIFT, _MOST_SHIFT + 1), key=abs):
        pairs = [
            (row, known[at])
            for row in seen.tolist()
            if (at := (int(views.number[row]) + shift, int(views.point[row]))) in known
        ]
        if len(pairs) < _LEAST:
            continue
        here, there = np.array(pairs)[:: -(-len(pairs) // _MOST)].T
        fractions[shift] = _fitting_fraction(points_m[there], rays[here], gate)
        if shift == 0 and fractions[0] >= _SOUND:
            break
    return fractions


def _points_of_others(rig: Rig, views: PointViews, index: int) -> Float[np.ndarray, "sightings 3"]:
    """Positions of the point by the other cameras, in the rig's unit; NaN where these do not agree."""
    others_px = views.points_px.copy()
    others_px[:, index] = np.nan
    points_m = triangulate_linearly(rig.cameras, others_px)
    expected_px, _ = project(rig.cameras, points_m[:, None])
    distance_px = np.linalg.norm(expected_px - others_px, axis=-1)
    agree = ~(distance_px > _FITS_PX).any(axis=1)
    return np.where(agree[:, None], points_m, np.nan)


def _fitting_fraction(
    points_m: Float[np.ndarray, "points 3"], rays: Float[np.ndarray, "points 2"], gate: float
) -> float:
    """Fraction of points that a camera sees along these rays, x / z and y / z, from the pose that fits most of them."""
    found = solve_pnp_ransac(points_m, rays, gate)
    return 0.0 if found is None else float(found[1].mean())

"""A check of a map against videos of its room: which markers are wrong, by how much, and what to do.

Markers are sound if the videos show them where the map has them, in views that are located by all markers with a robust
loss. The map is then built anew from the sound markers (`building`), and the differences are listed. The check fails
where fewer than half of the markers agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.calibration import spread_px
from psotrack.errors import InputError
from psotrack.inside_out.mapping.adjusting import adjust, adjusted_roughly
from psotrack.inside_out.mapping.building import BuiltMap, build_map
from psotrack.inside_out.mapping.initial_map import MarkerPlacer
from psotrack.inside_out.mapping.sightings import MarkerSightings
from psotrack.inside_out.marker_map import MarkerMap, PlacedMarker, fit_square

#: Median residual of a suspect marker, as a multiple of the usual median residual.
_SUSPECT = 4.0
#: Smallest number of frames from which a suspect marker is placed.
_LEAST_FRAMES = 3
#: Standard deviations of a corner in successive adjustments, from a rough start to the end, pixels.
_NOISES_PX = (8.0, 2.0, 0.5)
#: Number of standard deviations from which on a difference is significant.
_SIGNIFICANT = 5.0
#: Differences below these are expected of a map that was measured by hand or by motion capture, with errors of some
#: millimetres: of positions (metres), orientations (degrees) and sides (fraction of the side).
_SHIFT_M, _TURN_DEG, _SIDE_CHANGE = 0.01, 3.0, 0.03
#: A turn from which on a marker at its place was not hung crookedly: its corners are counted in another order, degrees.
_REORDERED_DEG = 60.0
#: Largest distance of two centres that are the same place, in sides.
_SAME_PLACE = 0.35


@dataclass(frozen=True)
class MapFinding:
    """A fault of a map.

    Attributes:
        kind: kind of the fault in a word or two, for programs.
        markers: ids of the wrong markers; empty where the whole map is wrong.
        message: what is wrong, and by how much.
        remedy: what to do.
    """

    kind: str
    markers: tuple[int, ...]
    message: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.message}; {self.remedy}"


@dataclass(frozen=True)
class MarkerDifference:
    """How a marker in the videos differs from the map.

    Attributes:
        moved_m: (3,), from the centre in the map to the centre in the videos, world.
        std_m: (3,), standard deviation of `moved_m`.
        turned_deg: angle between the axes in the map and in the videos, degrees.
        turn_std_deg: standard deviation of `turned_deg`.
        grown: side in the videos divided by the side in the map.
    """

    moved_m: Float[np.ndarray, "3"]
    std_m: Float[np.ndarray, "3"]
    turned_deg: float
    turn_std_deg: float
    grown: float


@dataclass(frozen=True)
class MapCheck:
    """Result of a check of a map.

    Attributes:
        findings: faults of the map; empty where nothing is wrong.
        sightings: number of frames that show a marker beside others of the map, by id.
        residual_px: median distance in the image between a marker's corners and those in the map, pixels, by id.
        differences: of suspect markers that could be placed anew, by id.
        noise_px: standard deviation of a corner along x and along y, pixels.
        num_views: number of frames that show at least two markers of the map.
        not_in_map: ids that are seen but not in the map.
    """

    findings: tuple[MapFinding, ...]
    sightings: Mapping[int, int]
    residual_px: Mapping[int, float]
    differences: Mapping[int, MarkerDifference]
    noise_px: float
    num_views: int
    not_in_map: tuple[int, ...]

    def to_dict(self) -> dict[str, Any]:
        """The result, fit for JSON."""
        found = {marker: dict(vars(one)) for marker, one in self.differences.items()}
        for one in found.values():
            one |= {name: one[name].tolist() for name in ("moved_m", "std_m")}
        counts = sorted(self.sightings.items())
        return {
            "findings": [{**vars(one), "markers": list(one.markers)} for one in self.findings],
            "frames": self.num_views,
            "noise_px": self.noise_px,
            "not_in_map": list(self.not_in_map),
            "markers": {
                marker: {"frames": count, "residual_px": self.residual_px.get(marker)} | found.get(marker, {})
                for marker, count in counts
            },
        }


def check_map(sightings: MarkerSightings, marker_map: MarkerMap) -> MapCheck:
    """Check a map against sightings.

    Raises:
        InputError: no frame shows two markers of the map.
    """
    given = {int(marker): fit_square(corners) for marker, corners in marker_map.corners_m.items()}
    not_in_map = tuple(marker for marker in sightings.ids if marker not in given)
    kept = np.isin(sightings.marker, list(given))
    kept &= (np.bincount(sightings.view[kept], minlength=sightings.num_views) >= 2)[sightings.view]
    if not kept.any():
        raise InputError(
            sightings.name,
            expected="frames that show two markers of the map",
            found="none",
            remedy="check that the map and the video are of the same room",
        )
    sightings = sightings.select(kept)
    distance_px = _distances_by_map(sightings, given)
    noise_px = spread_px(distance_px.ravel(), 0)
    residual_px = {
        marker: float(np.median(distance_px[sightings.marker == marker])) for marker in sightings.ids
    }
    # The median of a Rayleigh distribution is 1.18 standard deviations.
    suspects = [marker for marker, value in residual_px.items() if value > _SUSPECT * 1.18 * noise_px]
    differences: dict[int, MarkerDifference] = {}
    findings: list[MapFinding] = []
    sound = [marker for marker in residual_px if marker not in suspects]
    if 2 * len(sound) <= len(residual_px) or noise_px > _NOISES_PX[0]:
        message = (
            f"the map as a whole does not fit the video: {len(sound)} of {len(residual_px)} markers agree"
        )
        remedy = "check that lens, dictionary and map are those of this room, and that no axis is mirrored"
        findings.append(MapFinding("map", (), f"{message} with one another", remedy))
    elif suspects:
        known = {marker: marker_map.corners_m[marker] for marker in sound}
        built = build_map(sightings, known, estimate_sides=True)
        rows = {marker: row for row, marker in enumerate(built.ids.tolist())}
        for marker in suspects:
            if marker not in rows or built.sightings[rows[marker]] < _LEAST_FRAMES:
                message = f"marker {marker}: it is {residual_px[marker]:.1f} px off where the map has it"
                remedy = "too few frames show it beside others to tell where it is: film it with them"
                findings.append(MapFinding("disagrees", (marker,), message, remedy))
                continue
            found = fit_square(built.marker_map.corners_m[marker])
            differences[marker] = _difference(built, rows[marker], given[marker], found)
            findings += _faults(marker, given, found, differences[marker])
    counts = {marker: int((sightings.marker == marker).sum()) for marker in given}
    return MapCheck(
        tuple(findings), counts, residual_px, differences, noise_px, sightings.num_views, not_in_map
    )


def _distances_by_map(
    sightings: MarkerSightings, given: Mapping[int, PlacedMarker]
) -> Float[np.ndarray, "sightings 4"]:
    """Distances in the image in views that agree with most markers, with all markers where the map has them."""
    placer, T = MarkerPlacer(sightings, 1.0), None
    markers = {marker: given[marker] for marker in sightings.ids}
    for noise_px in (*_NOISES_PX, _NOISES_PX[-1]):
        # Near the end, a view in a wrong pose may find a better one.
        views = placer.locate_views(markers, T)[0][:, 0]
        rough = adjusted_roughly(sightings, markers, views, sightings.ids, noise_px=noise_px)
        T = rough.state.T_cam_world
    return adjust(sightings, rough).distance_px


def _difference(built: BuiltMap, row: int, given: PlacedMarker, found: PlacedMarker) -> MarkerDifference:
    moved = found.T_world_marker @ np.linalg.inv(given.T_world_marker)
    return MarkerDifference(
        found.T_world_marker[:3, 3] - given.T_world_marker[:3, 3],
        built.std_m[row],
        float(np.rad2deg(Rotation.from_matrix(moved[:3, :3]).magnitude())),
        float(np.rad2deg(np.linalg.norm(built.turn_std_rad[row]))),
        found.side_m / given.side_m,
    )


def _faults(
    marker: int, given: Mapping[int, PlacedMarker], found: PlacedMarker, by: MarkerDifference
) -> list[MapFinding]:
    """The fault of a marker whose place, turn or size is not that of the map; empty if the differences are usual."""
    shift_m, std_m = float(np.linalg.norm(by.moved_m)), float(np.linalg.norm(by.std_m))
    faults = {}
    remedy = "measure it again; `psotrack onboard map --known` with sound markers builds a map from the video"
    if shift_m > max(_SHIFT_M, _SIGNIFICANT * std_m):
        place = ", ".join(f"{value:.3f}" for value in found.T_world_marker[:3, 3])
        faults["moved"] = (
            f"{_metres(shift_m)} from where the map has it, at ({place}) m, give or take {_metres(std_m)}"
        )
        for other, one in given.items():
            apart_m = np.linalg.norm(found.T_world_marker[:3, 3] - one.T_world_marker[:3, 3])
            if other != marker and apart_m < _SAME_PLACE * one.side_m:
                faults["moved"] += f", where the map has marker {other}"
                remedy = "correct its id, in the map or on the wall"
    if by.turned_deg > max(_TURN_DEG, _SIGNIFICANT * by.turn_std_deg):
        faults["turned"] = f"turned by {by.turned_deg:.1f} degrees, give or take {by.turn_std_deg:.1f}"
        if by.turned_deg > _REORDERED_DEG and "moved" not in faults:
            remedy = "count its corners clockwise as seen from the room, from the marker's own top left"
    if abs(by.grown - 1) > _SIDE_CHANGE:
        faults["side"] = f"{1e3 * found.side_m:.0f} mm wide, not {found.side_m / by.grown * 1e3:.0f} mm"
    message = f"marker {marker}: it is {' and '.join(faults.values())}"
    return [MapFinding(next(iter(faults)), (marker,), message, remedy)] if faults else []


def _metres(length_m: float) -> str:
    if length_m >= 0.1:
        return f"{length_m:.2f} m"
    return f"{1e3 * length_m:.{0 if length_m >= 0.01 else 1}f} mm"

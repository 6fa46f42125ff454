"""Faults that a check of a map finds, in words: which marker is wrong, by how much, and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.inside_out.mapping.initial_map import PlacedMarker

#: Number of standard deviations from which on a difference is significant.
_SIGNIFICANT = 5.0
#: Differences below these are expected of a map that was measured by hand or by motion capture, whose corners are off
#: by some millimetres: of positions (metres), orientations (degrees) and sides (share of the side).
_SHIFT_M = 0.01
_TURN_DEG = 3.0
_SIDE_CHANGE = 0.03
#: Largest deviation, degrees, from a turn by 90, 180 or 270 degrees at which the order of the corners is the fault.
_QUARTER_DEG = 15.0
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
class CheckedMarker:
    """A marker of a map, compared with a video.

    Attributes:
        sightings: number of frames that show the marker beside others of the map.
        residual_px: median distance in the image between its corners and the corners in the map, pixels; NaN if unseen.
        moved_m: (3,), from the centre in the map to the centre in the video, world; NaN where the two agree.
        std_m: (3,), standard deviation of `moved_m`.
        turned_deg: angle between the axes in the map and in the video, degrees.
        turn_std_deg: standard deviation of `turned_deg`.
        side_ratio: side in the video divided by the side in the map.
    """

    sightings: int
    residual_px: float
    moved_m: Float[np.ndarray, "3"]
    std_m: Float[np.ndarray, "3"]
    turned_deg: float
    turn_std_deg: float
    side_ratio: float


def find_faults(
    given: Mapping[int, PlacedMarker],
    found: Mapping[int, PlacedMarker],
    checked: Mapping[int, CheckedMarker],
    suspects: list[int],
) -> list[MapFinding]:
    """Describe the faults of suspect markers; two exchanged markers are one fault.

    Args:
        given: all markers as in the map, by id.
        found: suspect markers as in the video, by id; a suspect that could not be placed is missing.
        checked: measurements of all markers, by id.
        suspects: ids of markers that the video shows elsewhere than the map.
    """
    findings, done = [], set()
    for marker in suspects:
        if marker in done:
            continue
        if marker not in found:
            findings.append(_unplaced(marker, checked[marker]))
            continue
        other = _marker_at(found[marker], given, excluded=marker)
        if other is not None and other in found and _same_place(found[other], given[marker]):
            done.add(other)
            findings.append(_exchanged(marker, other))
            continue
        finding = _fault(marker, given[marker], found[marker], checked[marker], other)
        if finding is not None:
            findings.append(finding)
    return findings


def _marker_at(found: PlacedMarker, given: Mapping[int, PlacedMarker], *, excluded: int) -> int | None:
    """Id of the marker of the map, other than the excluded one, at the place of a found marker."""
    return next(
        (other for other, one in given.items() if other != excluded and _same_place(found, one)), None
    )


def _same_place(one: PlacedMarker, other: PlacedMarker) -> bool:
    apart = float(np.linalg.norm(one.centre_m - other.centre_m))
    same_facing = float(one.R_world_marker[:, 2] @ other.R_world_marker[:, 2]) > 0
    return apart < _SAME_PLACE * other.side_m and same_facing


def _exchanged(marker: int, other: int) -> MapFinding:
    message = f"markers {marker} and {other}: each is where the map has the other one"
    return MapFinding("exchanged", (marker, other), message, "exchange their ids in the map, or on the wall")


def _unplaced(marker: int, one: CheckedMarker) -> MapFinding:
    message = (
        f"marker {marker}: it is {one.residual_px:.1f} px off where the map has it, in {one.sightings} frames"
    )
    remedy = (
        "too few frames show it beside others to tell where it is: film it with them, or measure it again"
    )
    return MapFinding("disagrees", (marker,), message, remedy)


def _fault(
    marker: int, given: PlacedMarker, found: PlacedMarker, one: CheckedMarker, other: int | None
) -> MapFinding | None:
    """The fault of one marker; None if the differences are usual for a measured map."""
    shift = float(np.linalg.norm(one.moved_m))
    moved = shift > max(_SHIFT_M, _SIGNIFICANT * float(np.linalg.norm(one.std_m)))
    turned = one.turned_deg > max(_TURN_DEG, _SIGNIFICANT * one.turn_std_deg)
    resized = abs(one.side_ratio - 1) > _SIDE_CHANGE
    stays = shift < _SAME_PLACE * given.side_m
    place = ", ".join(f"{value:.3f}" for value in found.centre_m)
    if stays and given.R_world_marker[:, 2] @ found.R_world_marker[:, 2] < -np.sqrt(0.5):
        message = f"marker {marker}: the map counts its corners backwards, so that it faces the wall"
        remedy = "count them clockwise as seen from the room, from the marker's own top left"
        return MapFinding("backwards", (marker,), message, remedy)
    quarter = _quarter_turns(given, found)
    if stays and quarter:
        message = (
            f"marker {marker}: the map counts its corners from another one, {90 * quarter} degrees around"
        )
        remedy = f"what the map calls corner {quarter + 1} is corner 1, the marker's own top left; or hang it upright"
        return MapFinding("corner order", (marker,), message, remedy)
    if other is not None:
        message = f"marker {marker}: it is where the map has marker {other}, {shift:.2f} m from its own place"
        return MapFinding("exchanged", (marker, other), message, "correct its id, in the map or on the wall")
    words = []
    if moved:
        words.append(
            f"{_metres(shift)} from where the map has it, at ({place}) m, give or take {_metres(_std(one))}"
        )
    if turned:
        words.append(f"turned by {one.turned_deg:.1f} degrees, give or take {one.turn_std_deg:.1f}")
    if resized:
        words.append(f"{1e3 * found.side_m:.0f} mm wide, not {1e3 * given.side_m:.0f} mm")
    if not words:
        return None
    kind = "moved" if moved else "turned" if turned else "side"
    remedy = "measure it again; `psotrack onboard map --known` with sound markers builds a map from the video"
    return MapFinding(kind, (marker,), f"marker {marker}: it is {' and '.join(words)}", remedy)


def _quarter_turns(given: PlacedMarker, found: PlacedMarker) -> int:
    """Quarter turns of a marker in its own plane, clockwise as seen from its front; 0 if it differs in another way."""
    turn = given.R_world_marker.T @ found.R_world_marker
    angle_deg = float(np.rad2deg(np.arctan2(turn[1, 0], turn[0, 0])))
    quarter = round(-angle_deg / 90) % 4
    off_deg = abs((-angle_deg - 90 * quarter + 180) % 360 - 180)
    return quarter if off_deg < _QUARTER_DEG and turn[2, 2] > np.cos(np.deg2rad(_QUARTER_DEG)) else 0


def _std(one: CheckedMarker) -> float:
    return float(np.linalg.norm(one.std_m))


def _metres(length_m: float) -> str:
    if length_m >= 0.1:
        return f"{length_m:.2f} m"
    return f"{1e3 * length_m:.{0 if length_m >= 0.01 else 1}f} mm"

"""What a check of a map finds, in words: which marker is wrong, by how much, and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.inside_out.mapping.start import Placed

#: Standard deviations that make a difference one.
_SURE = 5.0
#: Differences that a map measured by hand or by motion capture has: corners are off by some millimetres.
_SHIFT_M = 0.01
_TURN_DEG = 3.0
_GROWTH = 0.03
#: A marker that is turned in its plane by a quarter, give or take this, has its corners counted from another one.
_QUARTER_DEG = 15.0
#: Shares of the side that places may differ by and be the same.
_SAME_PLACE = 0.35


@dataclass(frozen=True)
class MapFinding:
    """A marker of a map that is wrong.

    Attributes:
        kind: a word or two for programs.
        markers: their ids; none where it is the whole map.
        message: what is wrong, by how much.
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
    """A marker of a map in a video.

    Attributes:
        sightings: frames that show it beside others of the map.
        residual_px: median distance in the image between its corners as seen and as the map has them; NaN if unseen.
        moved_m: (3,), from the map's centre to that in the video, world; NaN where it is where the map has it.
        std_m: (3,), of `moved_m`.
        turned_deg: between the map's axes and the video's.
        turn_std_deg: of that.
        grown: the side in the video over the map's.
    """

    sightings: int
    residual_px: float
    moved_m: Float[np.ndarray, "3"]
    std_m: Float[np.ndarray, "3"]
    turned_deg: float
    turn_std_deg: float
    grown: float


def findings_of(
    given: Mapping[int, Placed],
    found: Mapping[int, Placed],
    checked: Mapping[int, CheckedMarker],
    suspects: list[int],
) -> list[MapFinding]:
    """What is wrong with suspects, those that are exchanged together.

    Args:
        given: all markers of the map.
        found: suspects where the video has them; some may be absent.
        checked: what was measured of all markers.
        suspects: those that the video has not where the map has them.
    """
    findings, done = [], set()
    for marker in suspects:
        if marker in done:
            continue
        if marker not in found:
            findings.append(_unexplained(marker, checked[marker]))
            continue
        other = _place_of(marker, found[marker], given)
        if other is not None and other in found and _same_place(found[other], given[marker]):
            done.add(other)
            findings.append(_exchanged(marker, other))
            continue
        finding = _fault(marker, given[marker], found[marker], checked[marker], other)
        if finding is not None:
            findings.append(finding)
    return findings


def _place_of(marker: int, found: Placed, given: Mapping[int, Placed]) -> int | None:
    """Another marker of the map in whose place one is."""
    return next((other for other, one in given.items() if other != marker and _same_place(found, one)), None)


def _same_place(one: Placed, other: Placed) -> bool:
    apart = float(np.linalg.norm(one.centre_m - other.centre_m))
    faces_alike = float(one.R_world_marker[:, 2] @ other.R_world_marker[:, 2]) > 0
    return apart < _SAME_PLACE * other.side_m and faces_alike


def _exchanged(marker: int, other: int) -> MapFinding:
    message = f"markers {marker} and {other}: each is where the map has the other one"
    return MapFinding("exchanged", (marker, other), message, "exchange their ids in the map, or on the wall")


def _unexplained(marker: int, one: CheckedMarker) -> MapFinding:
    message = (
        f"marker {marker}: it is {one.residual_px:.1f} px off where the map has it, in {one.sightings} frames"
    )
    remedy = "it is too seldom seen beside others to tell where it is: film it with them, or measure it again"
    return MapFinding("disagrees", (marker,), message, remedy)


def _fault(
    marker: int, given: Placed, found: Placed, one: CheckedMarker, other: int | None
) -> MapFinding | None:
    """The one thing that is wrong with a marker, or all; None if it is no more than what maps are off by."""
    shift = float(np.linalg.norm(one.moved_m))
    moved = shift > max(_SHIFT_M, _SURE * float(np.linalg.norm(one.std_m)))
    turned = one.turned_deg > max(_TURN_DEG, _SURE * one.turn_std_deg)
    grown = abs(one.grown - 1) > _GROWTH
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
    if grown:
        words.append(f"{1e3 * found.side_m:.0f} mm wide, not {1e3 * given.side_m:.0f} mm")
    if not words:
        return None
    kind = "moved" if moved else "turned" if turned else "side"
    remedy = "measure it again; `psotrack map-markers --known` with sound markers builds a map from the video"
    return MapFinding(kind, (marker,), f"marker {marker}: it is {' and '.join(words)}", remedy)


def _quarter_turns(given: Placed, found: Placed) -> int:
    """Quarters by which a marker is turned in its own plane, clockwise as seen; 0 if it is not just that."""
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

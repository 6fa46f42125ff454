"""A map of markers from videos of a room, given at least one known marker, or the centres of its markers.

A known marker defines the origin, the axes and the scale of the world. If only the side of a marker is known, its own
axes are the world's: the origin at its centre, x to its right, y up, z out of the print.

If a table has the centres of the markers alone, a map is built in the world of the most seen marker. The similarity
that brings most of its centres to those of the table gives the turns and the sides. Each marker is then moved to its
centre in the table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration import GATE, Bundle
from psotrack.errors import InputError, check_positive
from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import Camera, cross_matrices
from psotrack.inside_out.mapping.adjusting import adjust, adjusted_roughly, covariance_of, markers_of
from psotrack.inside_out.mapping.initial_map import MarkerPlacer
from psotrack.inside_out.mapping.sightings import MOST_FRAMES, MarkerSightings, collect_sightings
from psotrack.inside_out.marker_map import SQUARE, MarkerCentres, MarkerMap, PlacedMarker, fit_square
from psotrack.support import evenly_spread, similarity

#: Number of views for the initial map; the other views are used for markers that none of these shows.
_FIRST_VIEWS = 100
#: Standard deviation of a corner along x and along y, pixels, before it is estimated from residuals.
_NOISE_PX = 0.3
#: Smallest fraction of a marker's sightings that its position must explain.
_EXPLAINED = 0.5
#: Smallest number of centres that must agree: three always agree with some similarity.
_LEAST_CENTRES = 4
#: Number of triples of markers that are tried; among them is one of right centres even if half of all are wrong.
_TRIPLES = 200


@dataclass(frozen=True)
class BuiltMap:
    """A map with its uncertainty.

    Attributes:
        marker_map: the markers that could be placed, with their standard deviations.
        ids: (markers,), increasing.
        covariance: (markers, 7, 7), of the centre along the world's axes (m), of a small turn about them (rad), and of
            the logarithm of the side; 0 for known quantities.
        residual_px: (markers,), root mean square distance of corners in the image, without outliers, pixels.
        sightings: (markers,), number of frames that show the marker.
        outliers: (markers,), number of these frames that do not fit.
        known: (markers,), whether the marker was given.
        unplaced: ids that are seen, but that no chain of neighbours leads to, or that have no certain position.
        noise_px: standard deviation of a corner along x and along y, pixels.
        inset_px: (videos,), distance by which the sides of squares are found too far inside, pixels.
        num_views: number of frames that were used.
    """

    marker_map: MarkerMap
    ids: Int[np.ndarray, " markers"]
    covariance: Float[np.ndarray, "markers 7 7"]
    residual_px: Float[np.ndarray, " markers"]
    sightings: Int[np.ndarray, " markers"]
    outliers: Int[np.ndarray, " markers"]
    known: Bool[np.ndarray, " markers"]
    unplaced: tuple[int, ...]
    noise_px: float
    inset_px: Float[np.ndarray, " videos"]
    num_views: int

    @property
    def std_m(self) -> Float[np.ndarray, "markers 3"]:
        """(markers, 3), standard deviations of the centres along the world's axes."""
        return np.sqrt(np.einsum("mii->mi", self.covariance)[:, :3])

    @property
    def turn_std_rad(self) -> Float[np.ndarray, "markers 3"]:
        """(markers, 3), standard deviations of small turns about the world's axes."""
        return np.sqrt(np.einsum("mii->mi", self.covariance)[:, 3:6])


def corners_in_own_frame(side_m: float) -> Float[np.ndarray, "4 3"]:
    """Corners, (4, 3), of a marker in its own axes, metres.

    Raises:
        SettingsError: the side is not above 0.
    """
    check_positive("side_m", side_m)
    return side_m * SQUARE


def build_map(
    sightings: MarkerSightings,
    known: Mapping[int, Float[np.ndarray, "4 3"]],
    *,
    side_m: float | None = None,
    estimate_sides: bool = False,
) -> BuiltMap:
    """Build the map that explains sightings, given the positions of some markers.

    Args:
        sightings: markers in videos of one room.
        known: corners, (4, 3), world, metres, of known markers, which stay where they are, by id; squares are fitted to
            them.
        side_m: side of all other markers, metres; None takes the known markers' side.
        estimate_sides: estimate the side of each other marker.

    Raises:
        InputError: no known marker is seen beside another one.
        SettingsError: the side is not above 0.
    """
    placed = {marker: fit_square(corners_m) for marker, corners_m in known.items()}
    side_m = float(np.median([one.side_m for one in placed.values()])) if side_m is None else side_m
    check_positive("side_m", side_m)
    _check_known(sightings, list(known))
    spread = evenly_spread(sightings.num_views, _FIRST_VIEWS)
    for part in (sightings.select(np.isin(sightings.view, spread)), sightings):
        if set(sightings.ids) - set(placed):
            placed = MarkerPlacer(part, side_m, estimate_sides).place_all(placed, _NOISE_PX)
    # Known markers that no frame shows are left out.
    placed = {marker: one for marker, one in placed.items() if marker in set(sightings.ids)}
    fixed = [marker for marker in known if marker in placed]
    tried: set[int] = set()
    T_before = None
    used = sightings
    while True:
        used, T = _connected(used, placed, T_before)
        rough = adjusted_roughly(used, placed, T, fixed, noise_px=_NOISE_PX, estimate_sides=estimate_sides)
        adjusted = adjust(used, rough)
        explained = {marker: adjusted.used[used.marker == marker, 0].mean() for marker in used.ids}
        bad = [marker for marker, part in explained.items() if part < _EXPLAINED and marker not in fixed]
        if not bad:
            return _result(sightings, used, adjusted, fixed)
        # A marker that most of its sightings contradict is placed again, or left out.
        found = markers_of(used, adjusted)
        placed = {marker: one for marker, one in found.items() if marker not in bad}
        placer, T_before = MarkerPlacer(used, side_m), adjusted.state.T_cam_world
        views = placer.locate_views(placed, T_before)
        again = {marker: placer.place(marker, views) for marker in bad if marker not in tried}
        placed |= {marker: one for marker, one in again.items() if one is not None}
        tried |= set(bad)


def _check_known(sightings: MarkerSightings, known: list[int]) -> None:
    seen = [marker for marker in known if marker in sightings.ids]
    views = set(sightings.view[np.isin(sightings.marker, seen)].tolist())
    beside = np.isin(sightings.view, list(views)) & ~np.isin(sightings.marker, seen)
    if not seen or not beside.any():
        found = "others beside it in no frame" if seen else f"only {', '.join(map(str, sightings.ids))}"
        raise InputError(
            sightings.name,
            expected=f"the known marker {', '.join(map(str, known))} beside others",
            found=found,
            remedy="name another one by --known",
        )


def _connected(
    sightings: MarkerSightings,
    placed: Mapping[int, PlacedMarker],
    before: Float[np.ndarray, "views 4 4"] | None = None,
) -> tuple[MarkerSightings, Float[np.ndarray, "connected 4 4"]]:
    """Sightings of placed markers in views that show at least two of them; and the poses of these views."""
    kept = np.isin(sightings.marker, list(placed))
    counts = np.bincount(sightings.view[kept], minlength=sightings.num_views)
    T = MarkerPlacer(sightings, 1.0).locate_views(placed, before)[0][:, 0]
    kept &= ((counts >= 2) & np.isfinite(T[:, 0, 0]))[sightings.view]
    return sightings.select(kept), T[np.unique(sightings.view[kept])]


def _result(sightings: MarkerSightings, used: MarkerSightings, bundle: Bundle, known: list[int]) -> BuiltMap:
    markers, covariance, is_used = markers_of(used, bundle), covariance_of(used, bundle), bundle.used[:, 0]
    ids = np.array(list(markers))
    of_marker = used.marker == ids[:, None]
    squares = (bundle.distance_px**2).mean(axis=1)
    stds_m = _std_m(np.array([one.corners_m for one in markers.values()]), covariance)
    # A marker that is not determined leaves no covariance known.
    std_m = dict(zip(markers, stds_m.tolist(), strict=True)) if np.isfinite(stds_m).all() else {}
    return BuiltMap(
        MarkerMap({marker: one.corners_m for marker, one in markers.items()}, std_m),
        ids,
        covariance,
        np.array([np.sqrt(squares[rows].mean()) if rows.any() else np.nan for rows in of_marker & is_used]),
        of_marker.sum(axis=1),
        (of_marker & ~is_used).sum(axis=1),
        np.isin(ids, known),
        tuple(marker for marker in sightings.ids if marker not in markers),
        float(bundle.problem.noise_px[0]),
        np.ravel(bundle.state.lenses),
        used.num_views,
    )


def _std_m(
    corners_m: Float[np.ndarray, "markers 4 3"], covariance: Float[np.ndarray, "markers 7 7"]
) -> Float[np.ndarray, " markers"]:
    """(markers,), standard deviations of a corner's position along an axis: root mean squares over corners and axes."""
    arms_m = corners_m - corners_m.mean(axis=1, keepdims=True)
    # A corner moves with the centre, with a turn w by w x arm, and with the logarithm of the side by its arm.
    by_turn = -cross_matrices(arms_m)
    slopes = np.concatenate([np.broadcast_to(np.eye(3), by_turn.shape), by_turn, arms_m[..., None]], axis=-1)
    return np.sqrt(np.einsum("mcif,mfg,mcig->m", slopes, covariance, slopes) / 12)


def complete_map(
    frames: Sequence[DetectedMarkers],
    centres: MarkerCentres,
    lens: Camera,
    *,
    side_m: float | None = None,
    name: str = "video",
) -> MarkerMap:
    """Find the corners of markers whose centres are known, from the frames of a video.

    Args:
        frames: detected markers of each frame.
        centres: centres of the markers.
        lens: intrinsics of the camera.
        side_m: side of all markers, metres; None estimates each marker's side.
        name: name of the video, for messages.

    Returns:
        The markers whose corners were found: not those that are seen in too few frames beside others, or do not fit.

    Raises:
        InputError: too few markers of the table are seen beside one another, or they do not fit.
    """
    known = [one.select(np.isin(one.ids, centres.ids)) for one in frames]
    several = [(0, float(number), one) for number, one in enumerate(known) if len(one) > 1]
    several = several[:: max(1, -(-len(several) // MOST_FRAMES))]
    sightings = collect_sightings(several, [lens], name) if several else None
    ids: list[int] = [] if sightings is None else sightings.ids
    if sightings is not None and len(ids) >= _LEAST_CENTRES:
        first = int(np.bincount(sightings.marker).argmax())
        built = build_map(
            sightings, {first: corners_in_own_frame(side_m or 1.0)}, estimate_sides=side_m is None
        )
        ids, centre_m = built.ids.tolist(), built.marker_map.centres_m
    if len(ids) < _LEAST_CENTRES:
        raise InputError(
            name,
            expected=f"{_LEAST_CENTRES} markers of the table that frames show beside one another",
            found=f"{len(ids)}",
            remedy="a table of corners needs fewer markers in sight",
        )
    to_m = np.array([centres.centres_m[marker] for marker in ids])
    # Few frames state no standard deviation.
    std_m = np.nan_to_num(np.linalg.norm(built.std_m, axis=1))
    fits, scale, R = _fit(centre_m, to_m, std_m, with_scale=side_m is None)
    if fits.sum() < _LEAST_CENTRES:
        raise InputError(
            name,
            expected="markers where the table has their centres",
            found=f"{fits.sum()} of {len(ids)} that fit one another",
            remedy="check --markers",
        )
    corners_m = {
        ids[row]: to_m[row] + scale * (built.marker_map.corners_m[ids[row]] - centre_m[row]) @ R.T
        for row in np.flatnonzero(fits).tolist()
    }
    return MarkerMap(corners_m)


def _fit(
    from_m: Float[np.ndarray, "markers 3"],
    to_m: Float[np.ndarray, "markers 3"],
    std_m: Float[np.ndarray, " markers"],
    *,
    with_scale: bool,
) -> tuple[Bool[np.ndarray, " markers"], float, Float[np.ndarray, "3 3"]]:
    """Which points fit the similarity whose median distance is smallest; its scale and rotation.

    Least median of squares over triples (P. J. Rousseeuw, 1984), then least squares of the points that fit.
    """

    def left_by(rows: np.ndarray) -> tuple[Float[np.ndarray, " markers"], float, Float[np.ndarray, "3 3"]]:
        scale, R, shift_m = similarity(from_m[rows], to_m[rows], with_scale=with_scale)
        return np.linalg.norm(scale * from_m @ R.T + shift_m - to_m, axis=1), scale, R

    rng = np.random.default_rng(0)
    tried = [left_by(rng.choice(len(from_m), 3, replace=False)) for _ in range(_TRIPLES)]
    distance_m, scale, R = min(tried, key=lambda one: float(np.median(one[0])))
    for _ in range(3):
        # The median of the length of a vector with three normal components is 1.54 standard deviations.
        spread_m = float(np.median(distance_m)) / 1.54
        fits = distance_m <= GATE * np.hypot(spread_m, scale * std_m)
        distance_m, scale, R = left_by(np.flatnonzero(fits))
    return fits, scale, R

"""A map of markers from videos of a room, given at least one known marker.

The known marker defines the origin, the axes and the scale of the world. If only the side of a marker is known, its own
axes are the world's: the origin at its centre, x to its right, y up, z out of the print.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, check_positive
from psotrack.inside_out.mapping.bundle import AdjustedMap, adjust
from psotrack.inside_out.mapping.initial_map import (
    MarkerPlacer,
    PlacedMarker,
    make_scene,
    place_markers,
    placed_markers,
)
from psotrack.inside_out.mapping.rolling import (
    LineTimes,
    Shutters,
    line_times,
    rolling_shutters,
    with_shutters,
)
from psotrack.inside_out.mapping.scene import MappedScene
from psotrack.inside_out.mapping.sightings import SQUARE, MarkerSightings
from psotrack.inside_out.mapping.square_fitting import fit_square
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import RollingShutter

#: Number of views for the initial map; the other views are used for markers that none of these shows.
_FIRST_VIEWS = 100
#: Standard deviation of a corner along x and along y, pixels, before it is estimated from residuals.
_NOISE_PX = 0.3
#: Smallest share of a marker's sightings that its position must explain.
_EXPLAINED = 0.5


@dataclass(frozen=True)
class BuiltMap:
    """A map with its uncertainty.

    Attributes:
        marker_map: the markers that could be placed.
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
        shutters: (videos,), rolling shutters with which the map was made; None is a global shutter.
        line_times: (videos,), what the videos show of their shutters; None where it was not estimated.
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
    shutters: Shutters = ()
    line_times: LineTimes = ()

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
    shutter: RollingShutter | None = None,
) -> BuiltMap:
    """Build the map that explains sightings, given the positions of some markers.

    Args:
        sightings: markers in videos of one room.
        known: corners, (4, 3), world, metres, of known markers, which stay where they are, by id; squares are fitted to
            them.
        side_m: side of all other markers, metres; None takes the known markers' side.
        estimate_sides: estimate the side of each other marker.
        shutter: rolling shutter of all cameras; None is estimated for each video. Where a video contradicts it, the
            covariance includes the difference from the map with the video's shutter.

    Raises:
        InputError: no known marker is seen beside another one.
        SettingsError: the side is not above 0.
    """
    given = (shutter,) * len(sightings.lenses)
    first = _build(with_shutters(sightings, given), known, side_m, estimate_sides)
    shown = line_times(sightings, first.marker_map)
    if shutter is None:
        if not any(one is not None and one.rolls for one in shown):
            return replace(first, shutters=given, line_times=shown)
        found = _build(with_shutters(sightings, rolling_shutters(shown)), known, side_m, estimate_sides)
        # A map bent by the shutter may have biased the line times. The map itself depends little on the line times,
        # because the motion in each view is free.
        shown = line_times(sightings, found.marker_map)
        return replace(found, shutters=rolling_shutters(shown), line_times=shown)
    first = replace(first, shutters=given, line_times=shown)
    if not any(one is not None and one.contradicts(shutter.line_time_s) for one in shown):
        return first
    other = _build(with_shutters(sightings, rolling_shutters(shown)), known, side_m, estimate_sides)
    return _with_difference(first, other)


def _with_difference(built: BuiltMap, other: BuiltMap) -> BuiltMap:
    """A map whose covariances include its difference from another map of the same markers."""
    covariance = built.covariance.copy()
    for row, marker in enumerate(built.ids.tolist()):
        if marker not in other.marker_map:
            continue
        (R, centre_m, side_m), (other_R, other_m, other_side_m) = (
            fit_square(one.marker_map.corners_m[marker]) for one in (built, other)
        )
        turn = Rotation.from_matrix(other_R @ R.T).as_rotvec()
        off = np.concatenate([other_m - centre_m, turn, [np.log(other_side_m / side_m)]])
        covariance[row] += np.outer(off, off)
    return replace(built, covariance=covariance)


def _build(
    sightings: MarkerSightings,
    known: Mapping[int, Float[np.ndarray, "4 3"]],
    side_m: float | None,
    estimate_sides: bool,
) -> BuiltMap:
    """Build the map with the shutters of the sightings."""
    placed = {marker: PlacedMarker(*fit_square(corners)) for marker, corners in known.items()}
    side_m = float(np.median([one.side_m for one in placed.values()])) if side_m is None else side_m
    check_positive("side_m", side_m)
    _check_known(sightings, list(known))
    first = sightings.select(_spread_views(sightings))
    placed = place_markers(first, placed, side_m, noise_px=_NOISE_PX, estimate_sides=estimate_sides)
    if set(sightings.ids) - set(placed):
        placed = place_markers(sightings, placed, side_m, noise_px=_NOISE_PX, estimate_sides=estimate_sides)
    # Known markers that no frame shows are left out.
    placed = {marker: one for marker, one in placed.items() if marker in set(sightings.ids)}
    connected, scene = _connect(sightings, placed, side_m)
    adjusted, connected = _adjust(
        connected, scene, [marker for marker in known if marker in placed], side_m, estimate_sides
    )
    return _make_result(sightings, connected, adjusted, list(known))


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


def _spread_views(sightings: MarkerSightings) -> Bool[np.ndarray, " sightings"]:
    """Which sightings belong to views that are spread evenly over all views."""
    count = min(_FIRST_VIEWS, sightings.num_views)
    views = np.linspace(0, sightings.num_views - 1, count).round().astype(int)
    return np.isin(sightings.view, views)


def _connect(
    sightings: MarkerSightings, placed: Mapping[int, PlacedMarker], side_m: float
) -> tuple[MarkerSightings, MappedScene]:
    """Sightings of placed markers in views that show at least two markers; and the scene of these markers and views."""
    kept = np.isin(sightings.marker, list(placed))
    counts = np.bincount(sightings.view[kept], minlength=sightings.num_views)
    connected = sightings.select(kept & (counts[sightings.view] >= 2))
    views = MarkerPlacer(connected, side_m).locate_views(placed)
    if np.isfinite(views.t_m[:, 0, 0]).all():
        return connected, make_scene(placed, views, np.zeros(len(connected.lenses)))
    found = np.isfinite(views.t_m[:, 0, 0])
    return _connect(connected.select(found[connected.view]), placed, side_m)


def _adjust(
    sightings: MarkerSightings, scene: MappedScene, fixed: list[int], side_m: float, estimate_sides: bool
) -> tuple[AdjustedMap, MarkerSightings]:
    """The adjusted scene. A marker that most of its sightings contradict is placed again, or left out."""
    tried: set[int] = set()
    while True:
        present = np.isin(scene.ids, sightings.ids)
        scene = MappedScene(
            scene.R_cam_world,
            scene.t_m,
            scene.ids[present],
            scene.R_world_marker[present],
            scene.centre_m[present],
            scene.side_m[present],
            scene.inset_px,
        )
        adjusted = adjust(sightings, scene, fixed, noise_px=_NOISE_PX, estimate_sides=estimate_sides)
        scene = adjusted.scene
        bad = [
            marker
            for marker in scene.ids.tolist()
            if marker not in fixed and adjusted.used[sightings.marker == marker].mean() < _EXPLAINED
        ]
        if not bad:
            return adjusted, sightings
        placed = placed_markers(scene)
        sound = {marker: one for marker, one in placed.items() if marker not in bad}
        placer = MarkerPlacer(sightings, side_m)
        views = placer.locate_views(sound, scene)
        for marker in bad:
            found = None if marker in tried else placer.place(marker, views)
            if found is not None:
                sound[marker] = found[0]
        tried |= set(bad)
        sightings, scene = _connect(sightings, sound, side_m)


def _make_result(
    sightings: MarkerSightings, used: MarkerSightings, adjusted: AdjustedMap, known: list[int]
) -> BuiltMap:
    scene = adjusted.scene
    ids = scene.ids.tolist()
    of_marker = [used.marker == marker for marker in ids]
    good = [rows & adjusted.used for rows in of_marker]
    return BuiltMap(
        MarkerMap(dict(zip(ids, scene.corners_m, strict=True))),
        scene.ids,
        adjusted.covariance,
        np.array(
            [np.sqrt(np.mean(adjusted.residual_px[rows] ** 2)) if rows.any() else np.nan for rows in good]
        ),
        np.array([rows.sum() for rows in of_marker]),
        np.array([(rows & ~adjusted.used).sum() for rows in of_marker]),
        np.isin(scene.ids, known),
        tuple(marker for marker in sightings.ids if marker not in ids),
        adjusted.noise_px,
        scene.inset_px,
        used.num_views,
    )

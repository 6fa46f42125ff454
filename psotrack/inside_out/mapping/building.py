"""A map of markers from videos of a room alone, up to one marker that is known.

Where the known marker is says where the world's origin is, how its axes are turned and how large it is. Of a marker of
which nothing is known but its side, the world's axes are its own: the origin in its centre, x to its right, y up, z out
of the print.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError, check_positive
from psotrack.inside_out.mapping.bundle import AdjustedMap, adjust
from psotrack.inside_out.mapping.scene import MappedScene
from psotrack.inside_out.mapping.sightings import SQUARE, MarkerSightings
from psotrack.inside_out.mapping.squares import best_square
from psotrack.inside_out.mapping.start import Beginning, Placed, begin, placed_of, scene_of
from psotrack.inside_out.marker_map import MarkerMap

#: Views that the first idea is from; the rest is needed for markers that none of them shows.
_FIRST_VIEWS = 100
#: Standard deviation of a corner, along x and along y, before residuals tell it.
_NOISE_PX = 0.3
#: Share of its sightings that a marker must explain, or it is not where it is thought to be.
_EXPLAINED = 0.5


@dataclass(frozen=True)
class BuiltMap:
    """A map, and how sure it is.

    Attributes:
        marker_map: the markers that could be placed.
        ids: (markers,), increasing.
        covariance: (markers, 7, 7), of the centre along the world's axes (m), of a small turn about them (rad), and of
            the logarithm of the side; 0 for what is known.
        residual_px: (markers,), root mean square distance of corners in the image, without outliers.
        sightings: (markers,), frames that show each.
        outliers: (markers,), of those, frames that do not fit.
        known: (markers,), which of them were given.
        unplaced: ids that are seen, but never beside markers that lead to a known one, or nowhere for sure.
        noise_px: standard deviation of a corner along x and along y.
        inset_px: (videos,), by how much the sides of squares are found too far inside.
        num_views: frames that were used.
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


def own_frame(side_m: float) -> Float[np.ndarray, "4 3"]:
    """The corners, (4, 3), of a marker in its own axes.

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
    """The map that explains what cameras see, given where some markers are.

    Args:
        sightings: of markers, in videos of one room.
        known: corners, (4, 3), world, metres, of markers that stay where they are, by id; squares are fitted to them.
        side_m: of all others; None takes that of the known ones.
        estimate_sides: let the sides of the others differ, and find them.

    Raises:
        InputError: no known marker is seen beside another one.
        SettingsError: the side is not above 0.
    """
    placed = {marker: Placed(*best_square(corners)) for marker, corners in known.items()}
    side_m = float(np.median([one.side_m for one in placed.values()])) if side_m is None else side_m
    check_positive("side_m", side_m)
    _check_known(sightings, list(known))
    first = sightings.select(_spread(sightings))
    placed = begin(first, placed, side_m, noise_px=_NOISE_PX, estimate_sides=estimate_sides)
    if set(sightings.ids) - set(placed):
        placed = begin(sightings, placed, side_m, noise_px=_NOISE_PX, estimate_sides=estimate_sides)
    # What was known but is never seen has no say.
    placed = {marker: one for marker, one in placed.items() if marker in set(sightings.ids)}
    tied, scene = _tied(sightings, placed, side_m)
    adjusted, tied = _settled(
        tied, scene, [marker for marker in known if marker in placed], side_m, estimate_sides
    )
    return _built(sightings, tied, adjusted, list(known))


def _check_known(sightings: MarkerSightings, known: list[int]) -> None:
    seen = [marker for marker in known if marker in sightings.ids]
    views = set(sightings.view[np.isin(sightings.marker, seen)].tolist())
    beside = np.isin(sightings.view, list(views)) & ~np.isin(sightings.marker, seen)
    if not seen or not beside.any():
        found = "others beside it in no frame" if seen else f"only {', '.join(map(str, sightings.ids))}"
        raise InputError(
            sightings.name,
            expected=f"marker {', '.join(map(str, known))}, that is known, beside others",
            found=found,
            remedy="name another one by --known",
        )


def _spread(sightings: MarkerSightings) -> Bool[np.ndarray, " sightings"]:
    count = min(_FIRST_VIEWS, sightings.num_views)
    views = np.linspace(0, sightings.num_views - 1, count).round().astype(int)
    return np.isin(sightings.view, views)


def _tied(
    sightings: MarkerSightings, placed: Mapping[int, Placed], side_m: float
) -> tuple[MarkerSightings, MappedScene]:
    """The sightings of placed markers in views that show two at least: fewer tie nothing; and the scene of them."""
    kept = np.isin(sightings.marker, list(placed))
    counts = np.bincount(sightings.view[kept], minlength=sightings.num_views)
    tied = sightings.select(kept & (counts[sightings.view] >= 2))
    views = Beginning(tied, side_m).located(placed)
    if np.isfinite(views.t_m[:, 0, 0]).all():
        return tied, scene_of(placed, views, np.zeros(len(tied.lenses)))
    found = np.isfinite(views.t_m[:, 0, 0])
    return _tied(tied.select(found[tied.view]), placed, side_m)


def _settled(
    sightings: MarkerSightings, scene: MappedScene, fixed: list[int], side_m: float, estimate_sides: bool
) -> tuple[AdjustedMap, MarkerSightings]:
    """The adjusted scene; a marker that most of its sightings disagree with is placed anew, or left out."""
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
        placed = placed_of(scene)
        sound = {marker: one for marker, one in placed.items() if marker not in bad}
        beginning = Beginning(sightings, side_m)
        views = beginning.located(sound, scene)
        for marker in bad:
            found = None if marker in tried else beginning.place(marker, views)
            if found is not None:
                sound[marker] = found[0]
        tried |= set(bad)
        sightings, scene = _tied(sightings, sound, side_m)


def _built(
    all_of_them: MarkerSightings, used: MarkerSightings, adjusted: AdjustedMap, known: list[int]
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
        tuple(marker for marker in all_of_them.ids if marker not in ids),
        adjusted.noise_px,
        scene.inset_px,
        used.num_views,
    )

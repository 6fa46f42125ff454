"""An initial map: markers are placed one after the other, from frames that show them beside placed markers.

A single square looks almost the same in two poses. Other frames tell which pose is right: in the right one the marker
stays where it is when the camera moves, in the other one it does not. The poses of both kinds are therefore compared in
many frames.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import NEAR_M, undistort
from psotrack.inside_out.mapping.bundle import improved
from psotrack.inside_out.mapping.scene import MappedScene
from psotrack.inside_out.mapping.sightings import SQUARE, MarkerSightings, square_poses

#: Number of sightings from which candidates of a marker's pose are taken, and in which they are compared.
_COMPARED_SIGHTINGS = 24
#: Standard deviation of a corner of markers that are placed but not adjusted, pixels.
_ROUGH_PX = 3.0
#: Sides that are tried, as multiples of the usual side: where sides are known, and where they are not.
_KNOWN_SIDE = np.ones(1)
SIDE_FACTORS = np.geomspace(0.2, 5.0, 41)


@dataclass(frozen=True)
class PlacedMarker:
    """Position of a marker.

    Attributes:
        R_world_marker: (3, 3), from the marker's axes to the world's.
        centre_m: (3,), centre, world, metres.
        side_m: side, metres.
    """

    R_world_marker: Float[np.ndarray, "3 3"]
    centre_m: Float[np.ndarray, "3"]
    side_m: float


@dataclass(frozen=True)
class ViewPoses:
    """Possible poses of the cameras of views, world to camera: two per view, which are equal where one is certain.

    Attributes:
        R: (views, 2, 3, 3), NaN where the view shows no placed marker.
        t_m: (views, 2, 3), metres.
        count: (views,), number of placed markers in the view.
    """

    R: Float[np.ndarray, "views 2 3 3"]
    t_m: Float[np.ndarray, "views 2 3"]
    count: Int[np.ndarray, " views"]


class MarkerPlacer:
    """Places markers and locates views from sightings; poses of single squares are computed only once.

    Args:
        sightings: markers in views.
        side_m: usual side of the markers, metres.
    """

    def __init__(self, sightings: MarkerSightings, side_m: float) -> None:
        self.sightings = sightings
        self.side_m = side_m
        self.R, self.t_m = square_poses(sightings, side_m)
        lens = sightings.lens[sightings.view]
        self.rays = np.empty_like(sightings.corners_px)
        self.focal_px = np.array([float(np.mean(np.diag(one.K)[:2])) for one in sightings.lenses])[lens]
        for index, one in enumerate(sightings.lenses):
            self.rays[lens == index] = undistort(one, sightings.corners_px[lens == index])
        self._start = np.searchsorted(sightings.view, np.arange(sightings.num_views + 1))

    def locate_views(
        self, placed: Mapping[int, PlacedMarker], before: MappedScene | None = None
    ) -> ViewPoses:
        """The views' poses by placed markers; the poses of an earlier scene are candidates as well."""
        num_views = self.sightings.num_views
        R, t_m = np.full((num_views, 2, 3, 3), np.nan), np.full((num_views, 2, 3), np.nan)
        count = np.zeros(num_views, int)
        known = np.isin(self.sightings.marker, list(placed)) & np.isfinite(self.t_m[:, 0, 0])
        for view in range(num_views):
            rows = np.arange(self._start[view], self._start[view + 1])
            rows = rows[known[rows]]
            count[view] = len(rows)
            if not len(rows):
                continue
            markers = [placed[marker] for marker in self.sightings.marker[rows].tolist()]
            axes = np.stack([marker.R_world_marker for marker in markers])
            centres = np.stack([marker.centre_m for marker in markers])
            sides = np.array([marker.side_m for marker in markers])
            tried_R = (self.R[rows] @ axes.swapaxes(-1, -2)[:, None]).reshape(-1, 3, 3)
            shifts = (self.t_m[rows] * (sides / self.side_m)[:, None, None]).reshape(-1, 3)
            tried_t = shifts - (tried_R @ np.repeat(centres, 2, axis=0)[..., None])[..., 0]
            if before is not None and np.isfinite(before.t_m[view]).all():
                tried_R = np.concatenate([tried_R, before.R_cam_world[view][None]])
                tried_t = np.concatenate([tried_t, before.t_m[view][None]])
            corners = centres[:, None] + (sides[:, None, None] * SQUARE) @ axes.swapaxes(-1, -2)
            off = self._losses(rows, corners, tried_R[:, None], tried_t[:, None]).sum(axis=1)
            off[~np.isfinite(off)] = np.inf
            if len(rows) == 1:
                chosen = [0, 1] if np.isfinite(off[1]) else [0, 0]
            else:
                chosen = [int(off.argmin())] * 2
            R[view], t_m[view] = tried_R[chosen], tried_t[chosen]
        return ViewPoses(R, t_m, count)

    def place(
        self, marker: int, views: ViewPoses, side_factors: Float[np.ndarray, " factors"] = _KNOWN_SIDE
    ) -> tuple[PlacedMarker, float] | None:
        """The position of a marker that fits most sightings, and its mean loss; None if no view shows the marker.

        Args:
            marker: id of the marker.
            views: possible poses of the views.
            side_factors: (factors,), sides that are tried, as multiples of the usual side.
        """
        rows = np.flatnonzero(
            (self.sightings.marker == marker)
            & np.isfinite(views.t_m[self.sightings.view, 0, 0])
            & np.isfinite(self.t_m[:, 0, 0])
        )
        if not len(rows):
            return None
        # Views with more markers come first, because they are surer; then views are spread over time.
        surest = rows[np.argsort(-np.minimum(views.count[self.sightings.view[rows]], 3), kind="stable")]
        surest = np.sort(surest[: max(_COMPARED_SIGHTINGS, len(rows) // 2)])
        rows = surest[np.linspace(0, len(surest) - 1, min(_COMPARED_SIGHTINGS, len(surest))).astype(int)]
        at = self.sightings.view[rows]
        R_cam, t_cam = views.R[at][:, :, None, None], views.t_m[at][:, :, None, None]
        R_marker, t_marker = self.R[rows][:, None, :, None], self.t_m[rows][:, None, :, None]
        t_marker = t_marker * side_factors[:, None]
        axes = np.broadcast_to(
            R_cam.swapaxes(-1, -2) @ R_marker, (len(rows), 2, 2, len(side_factors), 3, 3)
        ).reshape(-1, 3, 3)
        centres = (R_cam.swapaxes(-1, -2) @ (t_marker - t_cam)[..., None])[..., 0].reshape(-1, 3)
        sides = self.side_m * np.broadcast_to(side_factors, (len(rows), 2, 2, len(side_factors))).reshape(-1)
        corners = centres[:, None] + (sides[:, None, None] * SQUARE) @ axes.swapaxes(-1, -2)
        # (candidates, views, two poses): a view agrees with a candidate if one of its poses does.
        loss = np.stack(
            [
                self._losses(rows, corners[:, None], views.R[at, which], views.t_m[at, which])
                for which in range(2)
            ]
        ).min(axis=0)
        total = np.where(np.isfinite(loss), loss, np.inf).mean(axis=-1)
        best = int(total.argmin())
        if not np.isfinite(total[best]):
            return None
        return PlacedMarker(axes[best], centres[best], float(sides[best])), float(total[best])

    def _losses(
        self,
        rows: Int[np.ndarray, " rows"],
        corners_m: Float[np.ndarray, "*#candidates 4 3"],
        R: Float[np.ndarray, "*#candidates 3 3"],
        t_m: Float[np.ndarray, "*#candidates 3"],
    ) -> Float[np.ndarray, "*candidates"]:
        """Cauchy loss of sightings; world points and poses broadcast against the rows along the last axis."""
        points = corners_m @ R.swapaxes(-1, -2) + t_m[..., None, :]
        depth = points[..., 2]
        off = points[..., :2] / np.where(depth > NEAR_M, depth, np.nan)[..., None] - self.rays[rows]
        squares = (off**2).sum(axis=-1).sum(axis=-1) * (self.focal_px[rows] / _ROUGH_PX) ** 2
        # A marker behind the camera has the largest loss.
        return np.log1p(np.where(np.isfinite(squares), squares, 1e12))


def place_markers(
    sightings: MarkerSightings,
    known: Mapping[int, PlacedMarker],
    side_m: float,
    *,
    noise_px: float,
    estimate_sides: bool = False,
) -> dict[int, PlacedMarker]:
    """Roughly place all markers that known markers lead to.

    Args:
        sightings: markers in a moderate number of views: an adjustment follows each placed marker.
        known: known markers by id.
        side_m: side of the other markers, metres; an initial value if sides are estimated.
        noise_px: standard deviation of a corner, pixels.
        estimate_sides: estimate the sides of the markers that are not known.
    """
    placer = MarkerPlacer(sightings, side_m)
    placed, scene, inset_px = dict(known), None, np.zeros(len(sightings.lenses))
    side_factors = SIDE_FACTORS if estimate_sides else _KNOWN_SIDE
    unreachable: set[int] = set()
    while True:
        views = placer.locate_views(placed, scene)
        marker = _next_marker(sightings, views, set(placed) | unreachable)
        if marker is None:
            return placed
        found = placer.place(marker, views, side_factors)
        if found is None:
            unreachable.add(marker)
            continue
        placed[marker] = found[0]
        views = placer.locate_views(placed, scene)
        scene = make_scene(placed, views, inset_px)
        several = np.isin(sightings.marker, list(placed)) & (views.count[sightings.view] >= 2)
        if several.any():
            scene = _adjust_part(sightings, scene, several, list(known), noise_px, estimate_sides)
            inset_px = scene.inset_px
            placed |= {name: one for name, one in placed_markers(scene).items() if name not in known}


def _adjust_part(
    sightings: MarkerSightings,
    scene: MappedScene,
    kept: Bool[np.ndarray, " sightings"],
    fixed: Collection[int],
    noise_px: float,
    estimate_sides: bool,
) -> MappedScene:
    """A scene adjusted to a part of the sightings; views without any of these sightings are NaN."""
    part, views = sightings.select(kept), np.unique(sightings.view[kept])
    seen = set(part.ids)
    chosen = np.array([marker in seen for marker in scene.ids.tolist()])
    start = MappedScene(
        scene.R_cam_world[views],
        scene.t_m[views],
        scene.ids[chosen],
        scene.R_world_marker[chosen],
        scene.centre_m[chosen],
        scene.side_m[chosen],
        scene.inset_px,
    )
    better = improved(part, start, list(fixed), noise_px=noise_px, estimate_sides=estimate_sides)
    R, t_m = np.full_like(scene.R_cam_world, np.nan), np.full_like(scene.t_m, np.nan)
    R[views], t_m[views] = better.R_cam_world, better.t_m
    axes, centres, sides = scene.R_world_marker.copy(), scene.centre_m.copy(), scene.side_m.copy()
    axes[chosen], centres[chosen], sides[chosen] = better.R_world_marker, better.centre_m, better.side_m
    return MappedScene(R, t_m, scene.ids, axes, centres, sides, better.inset_px)


def make_scene(
    placed: Mapping[int, PlacedMarker], views: ViewPoses, inset_px: Float[np.ndarray, " videos"]
) -> MappedScene:
    """The scene of placed markers, with the likelier pose of each view."""
    ids = sorted(placed)
    return MappedScene(
        views.R[:, 0],
        views.t_m[:, 0],
        np.array(ids),
        np.stack([placed[marker].R_world_marker for marker in ids]),
        np.stack([placed[marker].centre_m for marker in ids]),
        np.array([placed[marker].side_m for marker in ids]),
        inset_px,
    )


def placed_markers(scene: MappedScene) -> dict[int, PlacedMarker]:
    """The markers of a scene, by id."""
    rows = zip(scene.ids.tolist(), scene.R_world_marker, scene.centre_m, scene.side_m.tolist(), strict=True)
    return {marker: PlacedMarker(axes, centre, side) for marker, axes, centre, side in rows}


def _next_marker(sightings: MarkerSightings, views: ViewPoses, done: set[int]) -> int | None:
    """The marker that most views show beside placed markers; None if there is none."""
    sure = np.minimum(views.count, 3)[sightings.view]
    weight = {
        marker: int(sure[sightings.marker == marker].sum()) for marker in sightings.ids if marker not in done
    }
    best = max(weight, key=lambda marker: weight[marker], default=None)
    return best if best is not None and weight[best] else None

"""A first idea of where markers are, from one that is known: one after the other, each from the frames that show it
together with some that are placed before.

A single square looks almost the same from two poses. Which of them is right is told by other frames: the right one
stays where it is when the camera moves, the other one does not. So the poses of both kinds are tried in many frames.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import NEAR_M, undistort
from psotrack.inside_out.mapping.bundle import improved
from psotrack.inside_out.mapping.scene import MappedScene
from psotrack.inside_out.mapping.sightings import SQUARE, MarkerSightings, two_poses

#: MarkerViews that a marker's poses are taken from, and tried in.
_TRIED = 24
#: Standard deviation of a corner of markers that are placed but not adjusted.
_ROUGH_PX = 3.0
#: Sides that are tried where they are not known, as shares of the one that is.
_KNOWN_SIDE = np.ones(1)
GROWTHS = np.geomspace(0.2, 5.0, 41)


@dataclass(frozen=True)
class Placed:
    """A marker that is placed: its axes and centre in the world, and its side."""

    R_world_marker: Float[np.ndarray, "3 3"]
    centre_m: Float[np.ndarray, "3"]
    side_m: float


@dataclass(frozen=True)
class MarkerViews:
    """Where the cameras of views may be, world to camera: two poses each, twice the same where one is sure.

    Attributes:
        R: (views, 2, 3, 3), NaN where no marker that is placed is seen.
        t_m: (views, 2, 3).
        count: (views,), markers that are placed.
    """

    R: Float[np.ndarray, "views 2 3 3"]
    t_m: Float[np.ndarray, "views 2 3"]
    count: Int[np.ndarray, " views"]


class Beginning:
    """What is worked out once of sightings, to place markers from them."""

    def __init__(self, sightings: MarkerSightings, side_m: float) -> None:
        self.sightings = sightings
        self.side_m = side_m
        self.R, self.t_m = two_poses(sightings, side_m)
        lens = sightings.lens[sightings.view]
        self.rays = np.empty_like(sightings.corners_px)
        self.focal_px = np.array([float(np.mean(np.diag(one.K)[:2])) for one in sightings.lenses])[lens]
        for index, one in enumerate(sightings.lenses):
            self.rays[lens == index] = undistort(one, sightings.corners_px[lens == index])
        self._start = np.searchsorted(sightings.view, np.arange(sightings.num_views + 1))

    def located(self, placed: Mapping[int, Placed], before: MappedScene | None = None) -> MarkerViews:
        """The views' poses from the markers that are placed; those of a scene before are tried too."""
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
        return MarkerViews(R, t_m, count)

    def place(
        self, marker: int, views: MarkerViews, growths: Float[np.ndarray, " growths"] = _KNOWN_SIDE
    ) -> tuple[Placed, float] | None:
        """Where a marker is in the world, of all that frames say the one that fits most of them; and its mean loss.

        Args:
            marker: its id.
            views: where the cameras may be.
            growths: (growths,), sides that are tried, as shares of the usual one.
        """
        rows = np.flatnonzero(
            (self.sightings.marker == marker)
            & np.isfinite(views.t_m[self.sightings.view, 0, 0])
            & np.isfinite(self.t_m[:, 0, 0])
        )
        if not len(rows):
            return None
        # Those with more markers first, which are surer, and then spread over time.
        surest = rows[np.argsort(-np.minimum(views.count[self.sightings.view[rows]], 3), kind="stable")]
        surest = np.sort(surest[: max(_TRIED, len(rows) // 2)])
        rows = surest[np.linspace(0, len(surest) - 1, min(_TRIED, len(surest))).astype(int)]
        at = self.sightings.view[rows]
        R_cam, t_cam = views.R[at][:, :, None, None], views.t_m[at][:, :, None, None]
        R_marker, t_marker = self.R[rows][:, None, :, None], self.t_m[rows][:, None, :, None]
        t_marker = t_marker * growths[:, None]
        axes = np.broadcast_to(
            R_cam.swapaxes(-1, -2) @ R_marker, (len(rows), 2, 2, len(growths), 3, 3)
        ).reshape(-1, 3, 3)
        centres = (R_cam.swapaxes(-1, -2) @ (t_marker - t_cam)[..., None])[..., 0].reshape(-1, 3)
        sides = self.side_m * np.broadcast_to(growths, (len(rows), 2, 2, len(growths))).reshape(-1)
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
        return Placed(axes[best], centres[best], float(sides[best])), float(total[best])

    def _losses(
        self,
        rows: Int[np.ndarray, " rows"],
        corners_m: Float[np.ndarray, "*#candidates 4 3"],
        R: Float[np.ndarray, "*#candidates 3 3"],
        t_m: Float[np.ndarray, "*#candidates 3"],
    ) -> Float[np.ndarray, "*candidates"]:
        """The Cauchy loss of sightings, with world points and poses that broadcast against them along the last axis."""
        points = corners_m @ R.swapaxes(-1, -2) + t_m[..., None, :]
        depth = points[..., 2]
        off = points[..., :2] / np.where(depth > NEAR_M, depth, np.nan)[..., None] - self.rays[rows]
        squares = (off**2).sum(axis=-1).sum(axis=-1) * (self.focal_px[rows] / _ROUGH_PX) ** 2
        # Behind a camera is as bad as anything.
        return np.log1p(np.where(np.isfinite(squares), squares, 1e12))


def begin(
    sightings: MarkerSightings,
    known: Mapping[int, Placed],
    side_m: float,
    *,
    noise_px: float,
    estimate_sides: bool = False,
) -> dict[int, Placed]:
    """Where all markers are that can be reached from known ones, roughly.

    Args:
        sightings: of not too many views: each marker that is placed is followed by an adjustment.
        known: markers by id.
        side_m: of those that are not known; a first guess if they are estimated.
        noise_px: standard deviation of a corner.
        estimate_sides: of those that are not known.
    """
    beginning = Beginning(sightings, side_m)
    placed, scene, inset_px = dict(known), None, np.zeros(len(sightings.lenses))
    growths = GROWTHS if estimate_sides else _KNOWN_SIDE
    unreachable: set[int] = set()
    while True:
        views = beginning.located(placed, scene)
        marker = _next(sightings, views, set(placed) | unreachable)
        if marker is None:
            return placed
        found = beginning.place(marker, views, growths)
        if found is None:
            unreachable.add(marker)
            continue
        placed[marker] = found[0]
        views = beginning.located(placed, scene)
        scene = scene_of(placed, views, inset_px)
        several = np.isin(sightings.marker, list(placed)) & (views.count[sightings.view] >= 2)
        if several.any():
            scene = improved_part(sightings, scene, several, list(known), noise_px, estimate_sides)
            inset_px = scene.inset_px
            placed |= {name: one for name, one in placed_of(scene).items() if name not in known}


def improved_part(
    sightings: MarkerSightings,
    scene: MappedScene,
    kept: Bool[np.ndarray, " sightings"],
    fixed: Collection[int],
    noise_px: float,
    estimate_sides: bool,
) -> MappedScene:
    """A scene adjusted to some of the sightings; the views without any are NaN."""
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


def scene_of(
    placed: Mapping[int, Placed], views: MarkerViews, inset_px: Float[np.ndarray, " videos"]
) -> MappedScene:
    """Markers that are placed, and the likelier pose of each view."""
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


def placed_of(scene: MappedScene) -> dict[int, Placed]:
    """The markers of a scene."""
    rows = zip(scene.ids.tolist(), scene.R_world_marker, scene.centre_m, scene.side_m.tolist(), strict=True)
    return {marker: Placed(axes, centre, side) for marker, axes, centre, side in rows}


def _next(sightings: MarkerSightings, views: MarkerViews, done: set[int]) -> int | None:
    """The marker that most frames show beside placed ones."""
    sure = np.minimum(views.count, 3)[sightings.view]
    weight = {
        marker: int(sure[sightings.marker == marker].sum()) for marker in sightings.ids if marker not in done
    }
    best = max(weight, key=lambda marker: weight[marker], default=None)
    return best if best is not None and weight[best] else None

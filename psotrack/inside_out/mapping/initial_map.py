"""An initial map: markers are placed one after the other, from frames that show them beside placed markers.

A single square looks almost the same in two poses. Other frames tell which pose is right: in the right one the marker
stays where it is when the camera moves, in the other one it does not. The poses of both kinds are therefore compared in
many frames.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from psotrack.geometry import NEAR_M
from psotrack.inside_out.mapping.adjusting import adjusted_roughly, markers_of
from psotrack.inside_out.mapping.sightings import MarkerSightings, square_poses
from psotrack.inside_out.marker_map import SQUARE, PlacedMarker

#: Number of sightings from which candidates of a marker's pose are taken, and in which they are compared.
_COMPARED_SIGHTINGS = 24
#: Standard deviation of a corner of markers that are placed but not adjusted, pixels.
_ROUGH_PX = 3.0
#: Sides that are tried, as multiples of the usual side, where sides are not known.
_SIDE_FACTORS = np.geomspace(0.2, 5.0, 41)


#: Possible poses of the cameras of views, world to camera, (views, 2, 4, 4): two per view, which are equal where one is
#: certain, and NaN where the view shows no placed marker; and (views,), the number of placed markers in the view.
ViewPoses = tuple[Float[np.ndarray, "views 2 4 4"], Int[np.ndarray, " views"]]


class MarkerPlacer:
    """Places markers and locates views from sightings; poses of single squares are computed only once.

    Args:
        sightings: markers in views.
        side_m: usual side of the markers, metres.
        estimate_sides: whether sides of placed markers are estimated.
    """

    def __init__(self, sightings: MarkerSightings, side_m: float, estimate_sides: bool = False) -> None:
        self.sightings, self._estimate_sides = sightings, estimate_sides
        self._sides_m = side_m * (_SIDE_FACTORS if estimate_sides else np.ones(1))
        self._T = square_poses(sightings)
        focal_px = np.array([float(np.mean(np.diag(one.K)[:2])) for one in sightings.lenses])
        self._focal_px = focal_px[sightings.lens[sightings.view]]

    def locate_views(
        self, placed: Mapping[int, PlacedMarker], before: Float[np.ndarray, "views 4 4"] | None = None
    ) -> ViewPoses:
        """The views' poses by placed markers; earlier poses are candidates as well."""
        num_views = self.sightings.num_views
        T, count = np.full((num_views, 2, 4, 4), np.nan), np.zeros(num_views, int)
        known = np.isin(self.sightings.marker, list(placed)) & np.isfinite(self._T[:, 0, 0, 0])
        for view in range(num_views):
            rows = np.flatnonzero(known & (self.sightings.view == view))
            count[view] = len(rows)
            if not len(rows):
                continue
            squares = [placed[marker] for marker in self.sightings.marker[rows].tolist()]
            to_marker = np.linalg.inv([square.T_world_marker for square in squares])
            sides = np.array([square.side_m for square in squares])
            tried = (_scaled(self._T[rows], sides[:, None]) @ to_marker[:, None]).reshape(-1, 4, 4)
            if before is not None and np.isfinite(before[view]).all():
                tried = np.concatenate([tried, before[view][None]])
            corners_m = np.array([square.corners_m for square in squares])
            loss = self._losses(rows, corners_m, tried[:, None]).sum(axis=1)
            loss[~np.isfinite(loss)] = np.inf
            best = int(loss.argmin())
            T[view] = tried[[0, 1 if np.isfinite(loss[1]) else 0] if len(rows) == 1 else [best, best]]
        return T, count

    def place(self, marker: int, views: ViewPoses) -> PlacedMarker | None:
        """The position of a marker that fits most sightings; None if no view shows the marker."""
        T_views, count = views
        at = self.sightings.view
        seen = np.isfinite(T_views[at, 0, 0, 0]) & np.isfinite(self._T[:, 0, 0, 0])
        rows = np.flatnonzero((self.sightings.marker == marker) & seen)
        if not len(rows):
            return None
        # Views with more markers come first, because they are surer; then views are spread over time.
        surest = rows[np.argsort(-np.minimum(count[at[rows]], 3), kind="stable")]
        surest = np.sort(surest[: max(_COMPARED_SIGHTINGS, len(rows) // 2)])
        rows = surest[np.linspace(0, len(surest) - 1, min(_COMPARED_SIGHTINGS, len(surest))).astype(int)]
        T_cam = T_views[at[rows]]
        # (views, two poses of the camera, two of the marker, sides)
        T = np.linalg.inv(T_cam)[:, :, None, None] @ _scaled(self._T[rows][:, None, :, None], self._sides_m)
        sides = np.broadcast_to(self._sides_m, T.shape[:-2]).ravel()
        T = T.reshape(-1, 4, 4)
        corners_m = T[:, None, :3, 3] + (sides[:, None, None] * SQUARE) @ T[:, :3, :3].swapaxes(-1, -2)
        # A view agrees with a candidate if one of its poses does.
        loss = np.minimum(*(self._losses(rows, corners_m[:, None], T_cam[:, which]) for which in range(2)))
        total = np.where(np.isfinite(loss), loss, np.inf).mean(axis=-1)
        best = int(total.argmin())
        return PlacedMarker(T[best], float(sides[best])) if np.isfinite(total[best]) else None

    def place_all(self, known: Mapping[int, PlacedMarker], noise_px: float) -> dict[int, PlacedMarker]:
        """Roughly place all markers that known markers lead to; an adjustment follows each placed marker.

        Args:
            known: known markers by id.
            noise_px: standard deviation of a corner, pixels.
        """
        placed, T = dict(known), None
        unreachable: set[int] = set()
        while True:
            T_views, count = self.locate_views(placed, T)
            several = count >= 2
            kept = np.isin(self.sightings.marker, list(placed)) & several[self.sightings.view]
            if kept.any():
                part = self.sightings.select(kept)
                bundle = adjusted_roughly(
                    part,
                    placed,
                    T_views[several, 0],
                    known,
                    noise_px=noise_px,
                    estimate_sides=self._estimate_sides,
                )
                T_views[several] = bundle.state.T_cam_world[:, None]
                better = markers_of(part, bundle)
                placed |= {marker: one for marker, one in better.items() if marker not in known}
            # The marker that most views show beside placed markers is the next one.
            weight = np.bincount(self.sightings.marker, np.minimum(count, 3)[self.sightings.view])
            weight[list((set(placed) | unreachable) & set(self.sightings.ids))] = 0
            if not weight.any():
                return placed
            marker = int(weight.argmax())
            found = self.place(marker, (T_views, count))
            if found is None:
                unreachable.add(marker)
            else:
                placed[marker] = found
            T = np.where(several[:, None, None], T_views[:, 0], np.nan)

    def _losses(
        self,
        rows: Int[np.ndarray, " rows"],
        corners_m: Float[np.ndarray, "*#candidates 4 3"],
        T: Float[np.ndarray, "*#candidates 4 4"],
    ) -> Float[np.ndarray, "*candidates"]:
        """Cauchy loss of sightings; world points and poses broadcast against the rows along the last axis."""
        points = corners_m @ T[..., :3, :3].swapaxes(-1, -2) + T[..., None, :3, 3]
        depth = points[..., 2]
        off = points[..., :2] / np.where(depth > NEAR_M, depth, np.nan)[..., None] - self.sightings.rays[rows]
        squares = (off**2).sum(axis=(-1, -2)) * (self._focal_px[rows] / _ROUGH_PX) ** 2
        # A marker behind the camera has the largest loss.
        return np.log1p(np.where(np.isfinite(squares), squares, 1e12))


def _scaled(
    T: Float[np.ndarray, "*#poses 4 4"], factor: Float[np.ndarray, "*#poses"]
) -> Float[np.ndarray, "*poses 4 4"]:
    """Poses whose shifts are multiplied by a factor."""
    scaled = np.broadcast_to(T, (*np.broadcast_shapes(T.shape[:-2], factor.shape), 4, 4)).copy()
    scaled[..., :3, 3] *= factor[..., None]
    return scaled

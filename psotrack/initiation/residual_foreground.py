"""Residual foreground: the foreground outside the known drones, and the search for a drone in it.

A known drone explains the foreground within its ellipse, which is slightly enlarged. These pixels are hidden: they
count neither for nor against another drone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.geometry import (
    Boxes,
    Camera,
    make_extents,
    moved_extents,
    project,
    project_boxes,
    triangulate_linearly,
)
from psotrack.support import stored_jit

#: A known drone's ellipse is enlarged by this factor and by this number of cells, because outlines are no ellipses, and
#: rotors blur.
ELLIPSE_FACTOR, ELLIPSE_MARGIN_CELLS = 1.3, 1.5
#: Smallest number of viewpoints that see a drone, where the rig has as many: with two, rays of different drones that
#: cross look like a drone.
MIN_VIEWPOINTS = 3
#: Smallest share of the cameras that should see a drone and do see it; an obstacle may hide it from the rest.
MIN_SEEING_SHARE = 0.75
#: A camera should see a drone if at least this share of its ellipse is in the image and outside known drones.
MIN_VISIBLE = 0.6
#: A camera sees a drone if the share of foreground in its ellipse exceeds the share in a ring around the ellipse by at
#: least this. The difference is used, because thin and small drones have gaps in their silhouettes.
MIN_CONTRAST = 0.1
#: Factors of the ellipse within which foreground belongs to the drone, in three steps: the first two find the drone,
#: the last places it.
WINDOWS = (1.6, 1.6, 1.2)
#: Smallest distance between two drones, as a share of the sum of their half axes; nearer drones are the same drone.
MIN_DISTANCE = 0.8


@dataclass(frozen=True)
class SearchVolume:
    """Cameras and region of the search, which are the same in all frames.

    Attributes:
        cameras: cameras with one leading axis, for the full image.
        viewpoint: (cameras,), viewpoint of each camera, see `triangulation.viewpoints`.
        bounds_m: (2, 3), corners of the region where drones may be: above the floor, because shadows lie on it.
        reduction: image pixels per silhouette pixel, along each side.
        min_viewpoints: smallest number of viewpoints that see a drone; None: three, or two if the rig has no third.
    """

    cameras: Camera
    viewpoint: Int[np.ndarray, "cameras"]
    bounds_m: Float[np.ndarray, "2 3"]
    reduction: int
    min_viewpoints: int | None = None

    @property
    def required_viewpoints(self) -> int:
        """Smallest number of viewpoints that see a drone."""
        if self.min_viewpoints is not None:
            return self.min_viewpoints
        return max(2, min(MIN_VIEWPOINTS, len(set(self.viewpoint.tolist()))))


@dataclass(frozen=True)
class ProjectedDrones:
    """Known drones and their ellipses in the silhouettes.

    Attributes:
        position_m: (frames, drones, 3), positions; NaN where a drone does not explain foreground.
        size_m: (drones, 3), full lengths along the world's axes.
        middle, half: (frames, drones, cameras, 2), middles and half axes of the ellipses, cells of the silhouettes.
        is_there: (frames, cameras), whether the camera has a frame; None where all cameras have all frames.
    """

    position_m: Float[np.ndarray, "frames drones 3"]
    size_m: Float[np.ndarray, "drones 3"]
    middle: Float[np.ndarray, "frames drones cameras 2"]
    half: Float[np.ndarray, "frames drones cameras 2"]
    is_there: Bool[np.ndarray, "frames cameras"] | None = None

    def join(self, other: ProjectedDrones) -> ProjectedDrones:
        """Drones of both records."""
        return ProjectedDrones(
            np.concatenate([self.position_m, other.position_m], axis=1),
            np.concatenate([self.size_m, other.size_m]),
            np.concatenate([self.middle, other.middle], axis=1),
            np.concatenate([self.half, other.half], axis=1),
            self.is_there,
        )

    def without(self, drone: int) -> ProjectedDrones:
        """The same drones; one of them explains no foreground."""
        keep = (np.arange(len(self.size_m)) != drone)[:, None]
        return replace(
            self,
            position_m=np.where(keep, self.position_m, np.nan),
            middle=np.where(keep[..., None], self.middle, np.nan),
        )


@dataclass(frozen=True)
class ResidualForeground:
    """Foreground of one frame outside the known drones, which is computed for the parts that are looked at.

    Attributes:
        coverage: (cameras, height, width), silhouettes of the frame.
        drones: the known drones.
        frame: number of the frame in `drones`.
    """

    coverage: UInt8[np.ndarray, "cameras height width"]
    drones: ProjectedDrones
    frame: int

    def part(
        self, camera: int, rows: slice = slice(None), columns: slice = slice(None)
    ) -> tuple[UInt8[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
        """Part of a camera's image: the foreground, 0 to 255, and the pixels that no known drone hides."""
        coverage = self.coverage[camera, rows, columns]
        if self.drones.is_there is not None and not self.drones.is_there[self.frame, camera]:
            return np.zeros_like(coverage), np.zeros(coverage.shape, bool)
        visible = np.ones(coverage.shape, np.uint8)
        middle = self.drones.middle[self.frame, :, camera] - (columns.start or 0, rows.start or 0)
        half = self.drones.half[self.frame, :, camera] * ELLIPSE_FACTOR + ELLIPSE_MARGIN_CELLS
        for drone in np.flatnonzero(_overlap_image(middle, half, coverage.shape)).tolist():
            # OpenCV's coordinates begin at the middle of the first pixel; with shift=4 they are sixteenths of pixels.
            x, y = np.rint(16 * (middle[drone] - 0.5)).astype(int).tolist()
            axes = np.rint(16 * half[drone]).astype(int).tolist()
            cv2.ellipse(visible, (x, y), axes, 0, 0, 360, 0, cv2.FILLED, shift=4)
        return coverage * visible, visible.astype(bool)


@dataclass(frozen=True)
class Observation:
    """Result of the search for a drone at one place in one frame.

    Attributes:
        position_m: (3,), the place, moved to the middle of the foreground around it.
        num_cameras: number of cameras that see a drone there.
        found: whether enough viewpoints and cameras see a drone there.
        spread: mean square distance of the foreground from its middle, in half axes; 0.5 for a full ellipse.
    """

    position_m: Float[np.ndarray, "3"]
    num_cameras: int
    found: bool
    spread: float


#: The observation of no drone.
NOT_FOUND = Observation(np.full(3, np.nan), 0, False, np.nan)


def project_drones(
    volume: SearchVolume,
    position_m: Float[np.ndarray, "frames drones 3"],
    size_m: Float[np.ndarray, "drones 3"],
    moved_m: Float[np.ndarray, "frames drones cameras 3"] | None = None,
) -> ProjectedDrones:
    """Project drones into the silhouettes; a drone without a position (NaN) explains no foreground.

    Args:
        volume: the cameras, and the region of the search.
        position_m: (frames, drones, 3), positions, metres.
        size_m: (drones, 3), full lengths, metres.
        moved_m: (frames, drones, cameras, 3), motion of the drones from the instant to each camera's exposure, metres;
            None where all cameras' frames were exposed at the instant.
    """
    return ProjectedDrones(position_m, size_m, *_ellipses(volume, position_m, size_m, moved_m))


def observe(
    volume: SearchVolume,
    residual: ResidualForeground,
    position_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
) -> Observation:
    """Search for a drone near a place in one frame, and locate it.

    Args:
        volume: the cameras, and the region where drones may be.
        residual: foreground of the frame outside the known drones.
        position_m: (3,), the place, which may be wrong by half of the drone's size.
        size_m: (3,), full lengths of the drone that is searched.
    """
    for window in WINDOWS:
        views = _observe_views(volume, residual, position_m, size_m, window)
        if len(set(volume.viewpoint[views.sees].tolist())) < volume.required_viewpoints:
            return NOT_FOUND
        position_m = triangulate_linearly(volume.cameras, views.pixels, views.weight)
    others_m, others_size_m = residual.drones.position_m[residual.frame], residual.drones.size_m
    distance = np.linalg.norm(2 * (others_m - position_m) / (others_size_m + size_m), axis=-1)
    num_cameras = int(views.sees.sum())
    found = (
        num_cameras >= MIN_SEEING_SHARE * int(views.should_see.sum())
        and bool(((position_m >= volume.bounds_m[0]) & (position_m <= volume.bounds_m[1])).all())
        and not bool((distance < MIN_DISTANCE).any())
    )
    return Observation(position_m, num_cameras, found, float(np.median(views.spread[views.sees])))


@dataclass(frozen=True)
class _Views:
    """What each camera shows of a drone at one place.

    Attributes:
        pixels: (cameras, 2), middle of the drone's foreground, pixels of the image; NaN where the camera does not see
            it.
        weight: (cameras,), weight of the pixels in the triangulation.
        spread: (cameras,), as in `Observation`.
        sees: (cameras,), whether the camera sees a drone.
        should_see: (cameras,), whether enough of the drone's ellipse is in the image and outside known drones.
    """

    pixels: Float[np.ndarray, "cameras 2"]
    weight: Float[np.ndarray, "cameras"]
    spread: Float[np.ndarray, "cameras"]
    sees: Bool[np.ndarray, "cameras"]
    should_see: Bool[np.ndarray, "cameras"]


def _observe_views(
    volume: SearchVolume,
    residual: ResidualForeground,
    position_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
    window: float,
) -> _Views:
    """Search for a drone at one place in each camera.

    The middle of the foreground is compared with the middle of the visible part of the ellipse. So a part that a known
    drone hides, or that the image's border cuts off, does not shift the result.
    """
    middle, half = (value[0, 0] for value in _ellipses(volume, position_m[None, None], size_m[None]))
    # A cell is a mean over a square, which adds the variance 1/12 along each side to the ellipse's variance half² / 4.
    half = np.sqrt(half**2 + 1 / 3)
    shape = residual.coverage.shape
    pixels, weight, spread = np.full((len(middle), 2), np.nan), *np.zeros((2, len(middle)))
    sees, should_see = np.zeros((2, len(middle)), bool)
    _, depth = project(volume.cameras, position_m)
    for camera in np.flatnonzero(_overlap_image(middle, half, shape)).tolist():
        reach = max(WINDOWS) * half[camera]
        low = np.floor(np.maximum(middle[camera] - reach, 0)).astype(int)
        high = np.ceil(np.minimum(middle[camera] + reach, (shape[2], shape[1]))).astype(int)
        x, y = (np.arange(low[axis], high[axis]) + 0.5 for axis in range(2))
        u, v = (x - middle[camera, 0]) / half[camera, 0], (y - middle[camera, 1]) / half[camera, 1]
        radius = np.hypot(u, v[:, None])
        values, visible = residual.part(camera, slice(low[1], high[1]), slice(low[0], high[0]))
        foreground = values / 255
        inside, ring = (radius <= 1) & visible, (radius > 1) & visible
        share = inside.sum() / (np.pi * half[camera].prod())
        filled, around = (foreground[where].sum() / max(where.sum(), 1) for where in (inside, ring))
        should_see[camera] = share >= MIN_VISIBLE
        sees[camera] = should_see[camera] and filled - around >= MIN_CONTRAST
        if sees[camera]:
            mass = foreground * (radius <= window)
            shift = np.array(_middle(mass, x, y)) - _middle(inside, x, y)
            pixels[camera] = (middle[camera] + shift) * volume.reduction - 0.5
            spread[camera] = _spread(foreground, u, v)
            # The errors of the triangulation's equations are the pixels' errors times the depth.
            weight[camera] = min(share, 1.0) / depth[camera] ** 2
    return _Views(pixels, weight, spread, sees, should_see)


def _middle(
    mass: np.ndarray, x: Float[np.ndarray, "width"], y: Float[np.ndarray, "height"]
) -> tuple[float, float]:
    """Means of x and y over a mass of shape (height, width)."""
    columns, rows = mass.sum(axis=0), mass.sum(axis=1)
    total = columns.sum()
    return float(columns @ x / total), float(rows @ y / total)


def _spread(mass: np.ndarray, u: Float[np.ndarray, "width"], v: Float[np.ndarray, "height"]) -> float:
    (mean_u, mean_v), squares = _middle(mass, u, v), _middle(mass, u**2, v**2)
    return sum(squares) - mean_u**2 - mean_v**2


def _ellipses(
    volume: SearchVolume,
    position_m: Float[np.ndarray, "frames drones 3"],
    size_m: Float[np.ndarray, "drones 3"],
    moved_m: Float[np.ndarray, "frames drones cameras 3"] | None = None,
) -> tuple[Float[np.ndarray, "frames drones cameras 2"], Float[np.ndarray, "frames drones cameras 2"]]:
    """Middles and half axes of ellipses, cells; NaN where there is no drone, or the drone is behind the camera."""
    if not len(size_m):
        none = np.empty((len(position_m), 0, len(volume.viewpoint), 2))
        return none, none
    boxes = (
        _project_boxes(volume.cameras, size_m, position_m)
        if moved_m is None
        else _project_moved_boxes(volume.cameras, size_m, position_m, np.nan_to_num(moved_m))
    )
    behind = ~np.asarray(boxes.in_front)
    middle = np.stack([boxes.x_middle, boxes.y_middle], axis=-1).astype(np.float64) / volume.reduction
    half = np.stack([boxes.x_half, boxes.y_half], axis=-1).astype(np.float64) / volume.reduction
    middle[behind], half[behind] = np.nan, np.nan
    return middle, half


@stored_jit
def _project_boxes(
    cameras: Camera, size_m: Float[jax.Array, "drones 3"], position_m: Float[jax.Array, "frames drones 3"]
) -> Boxes:
    return project_boxes(make_extents(cameras, size_m), position_m)


@stored_jit
def _project_moved_boxes(
    cameras: Camera,
    size_m: Float[jax.Array, "drones 3"],
    position_m: Float[jax.Array, "frames drones 3"],
    moved_m: Float[jax.Array, "frames drones cameras 3"],
) -> Boxes:
    extents = make_extents(cameras, size_m)

    def of_frame(position: jax.Array, moved: jax.Array) -> Boxes:
        return project_boxes(moved_extents(extents, moved), position)

    return jax.vmap(of_frame)(position_m, moved_m)


def _overlap_image(
    middle: Float[np.ndarray, "*drones 2"], half: Float[np.ndarray, "*drones 2"], shape: tuple[int, ...]
) -> Bool[np.ndarray, "*drones"]:
    """Whether ellipses overlap images of a shape; False for NaN."""
    return ((middle + half > 0) & (middle - half < (shape[-1], shape[-2]))).all(axis=-1)

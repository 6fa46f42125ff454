"""What known drones leave unexplained in a frame's silhouettes, and whether a drone is at some place in it.

A known drone explains the foreground within its ellipse, a little enlarged. Whatever is behind that cannot be seen: it
speaks neither for a drone nor against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.geometry import Boxes, Camera, make_extents, project, project_boxes, triangulate

#: Known drones explain their ellipse, so much larger and so many cells wider: outlines are no ellipses, rotors blur.
EXPLAINED, EXPLAINED_CELLS = 1.3, 1.5
#: Viewpoints that must see a drone: two cannot tell it from crossings of different drones' rays.
MIN_VIEWPOINTS = 3
#: Of the cameras that ought to see it, so many must; before the others there may be an obstacle.
MIN_SEEING = 0.75
#: A camera ought to see a drone of which so much is in its image and clear of known drones ...
MIN_VISIBLE = 0.6
#: ... and does where so much more of that is foreground than of the ring about it. Thin drones, and small ones, fall
#: apart: the share itself says little.
MIN_CONTRAST = 0.1
#: Foreground belongs to a drone as far as its ellipse, so much larger; first to find it, then to place it.
WINDOWS = (1.6, 1.6, 1.2)
#: Ellipsoids of two drones that reach into one another deeper than to this share of their half axes are of one drone.
MIN_APART = 0.8


@dataclass(frozen=True)
class SearchVolume:
    """What is the same in all frames.

    Attributes:
        cameras: with one leading axis, of the image (not reduced).
        viewpoint: (cameras,), see `triangulation.viewpoints`.
        bounds_m: (2, 3), corners of where drones are: clear of the floor, on which shadows lie.
        reduction: image pixels per silhouette pixel, along each side.
    """

    cameras: Camera
    viewpoint: Int[np.ndarray, "cameras"]
    bounds_m: Float[np.ndarray, "2 3"]
    reduction: int


@dataclass(frozen=True)
class Known:
    """Drones that explain foreground.

    Attributes:
        position_m: (frames, drones, 3), NaN where a drone explains nothing.
        size_m: (drones, 3), full lengths along the world's axes.
        middle, half: (frames, drones, cameras, 2), of their ellipses in cells of the silhouettes.
    """

    position_m: Float[np.ndarray, "frames drones 3"]
    size_m: Float[np.ndarray, "drones 3"]
    middle: Float[np.ndarray, "frames drones cameras 2"]
    half: Float[np.ndarray, "frames drones cameras 2"]


@dataclass(frozen=True)
class Rest:
    """A frame without the known drones: foreground, 0..255, and where any would be seen."""

    foreground: UInt8[np.ndarray, "cameras height width"]
    visible: Bool[np.ndarray, "cameras height width"]


@dataclass(frozen=True)
class Glance:
    """A place in one frame.

    Attributes:
        position_m: (3,), the place, moved to the middle of the foreground about it.
        num_cameras: that see a drone there.
        there: whether enough viewpoints do, and hardly a camera does not.
        spread: mean square distance of the foreground from its middle, in half axes; 0.5 for a full ellipse.
    """

    position_m: Float[np.ndarray, "3"]
    num_cameras: int
    there: bool
    spread: float


NOTHING = Glance(np.full(3, np.nan), 0, False, np.nan)


def known(
    room: SearchVolume,
    position_m: Float[np.ndarray, "frames drones 3"],
    size_m: Float[np.ndarray, "drones 3"],
) -> Known:
    """Drones that explain foreground where they have a position."""
    return Known(position_m, size_m, *_ellipses(room, position_m, size_m))


def both(one: Known, other: Known) -> Known:
    """The drones of one and of the other."""
    return Known(
        np.concatenate([one.position_m, other.position_m], axis=1),
        np.concatenate([one.size_m, other.size_m]),
        np.concatenate([one.middle, other.middle], axis=1),
        np.concatenate([one.half, other.half], axis=1),
    )


def rest(coverage: UInt8[np.ndarray, "cameras height width"], drones: Known, frame: int) -> Rest:
    """What the drones leave of a frame's silhouettes."""
    visible = np.ones(coverage.shape, np.uint8)
    half = drones.half[frame] * EXPLAINED + EXPLAINED_CELLS
    for drone, camera in np.argwhere(_meets(drones.middle[frame], half, coverage.shape)).tolist():
        # OpenCV counts from the middle of the first pixel, in sixteenths.
        x, y = np.rint(16 * (drones.middle[frame, drone, camera] - 0.5)).astype(int).tolist()
        axes = np.rint(16 * half[drone, camera]).astype(int).tolist()
        cv2.ellipse(visible[camera], (x, y), axes, 0, 0, 360, 0, cv2.FILLED, shift=4)
    return Rest(coverage * visible, visible.astype(bool))


def glance(
    room: SearchVolume,
    left: Rest,
    others_m: Float[np.ndarray, "drones 3"],
    others_size_m: Float[np.ndarray, "drones 3"],
    position_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
) -> Glance:
    """Whether a drone is about a place in a frame, and where exactly.

    Args:
        room: the cameras, and the bounds that a drone is within.
        left: what the known drones leave of the frame.
        others_m: (drones, 3), where they are; NaN where they are not.
        others_size_m: (drones, 3).
        position_m: (3,), where a drone may be, to half of its size.
        size_m: (3,), of the drone that may be there.
    """
    for window in WINDOWS:
        pixels, weight, spread, seeing, ought = _evidence(room, left, position_m, size_m, window)
        if len(set(room.viewpoint[seeing].tolist())) < MIN_VIEWPOINTS:
            return NOTHING
        position_m = triangulate(room.cameras, pixels, weight)
    apart = np.linalg.norm(2 * (others_m - position_m) / (others_size_m + size_m), axis=-1)
    there = (
        int(seeing.sum()) >= MIN_SEEING * int(ought.sum())
        and bool(((position_m >= room.bounds_m[0]) & (position_m <= room.bounds_m[1])).all())
        and not bool((apart < MIN_APART).any())
    )
    return Glance(position_m, int(seeing.sum()), there, float(np.median(spread[seeing])))


def _evidence(
    room: SearchVolume,
    left: Rest,
    position_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
    window: float,
) -> tuple[
    Float[np.ndarray, "cameras 2"],
    Float[np.ndarray, "cameras"],
    Float[np.ndarray, "cameras"],
    Bool[np.ndarray, "cameras"],
    Bool[np.ndarray, "cameras"],
]:
    """Where each camera sees the drone (pixels), how much that counts, its spread, who sees it, and who ought to.

    The middle of the foreground is compared with the middle of what can be seen of the ellipse, so that a part hidden
    by a known drone or cut by the border does not shift it.
    """
    middle, half = (value[0, 0] for value in _ellipses(room, position_m[None, None], size_m[None]))
    # A cell is the mean over its square, of variance 1/12 along each side; that of an ellipse is half² / 4.
    half = np.sqrt(half**2 + 1 / 3)
    shape = left.visible.shape
    pixels, weight, spread = np.full((len(middle), 2), np.nan), *np.zeros((2, len(middle)))
    seeing, ought = np.zeros((2, len(middle)), bool)
    _, depth = project(room.cameras, position_m)
    for camera in np.flatnonzero(_meets(middle, half, shape)):
        reach = max(WINDOWS) * half[camera]
        low = np.floor(np.maximum(middle[camera] - reach, 0)).astype(int)
        high = np.ceil(np.minimum(middle[camera] + reach, (shape[2], shape[1]))).astype(int)
        x, y = (np.arange(low[axis], high[axis]) + 0.5 for axis in range(2))
        u, v = (x - middle[camera, 0]) / half[camera, 0], (y - middle[camera, 1]) / half[camera, 1]
        radius = np.hypot(u, v[:, None])
        cut = (camera, slice(low[1], high[1]), slice(low[0], high[0]))
        visible, foreground = left.visible[cut], left.foreground[cut] / 255
        inside, ring = (radius <= 1) & visible, (radius > 1) & visible
        share = inside.sum() / (np.pi * half[camera].prod())
        filled, around = (foreground[where].sum() / max(where.sum(), 1) for where in (inside, ring))
        ought[camera] = share >= MIN_VISIBLE
        seeing[camera] = ought[camera] and filled - around >= MIN_CONTRAST
        if seeing[camera]:
            mass = foreground * (radius <= window)
            shift = np.array([_mean(mass, x) - _mean(inside, x), _mean(mass.T, y) - _mean(inside.T, y)])
            pixels[camera] = (middle[camera] + shift) * room.reduction - 0.5
            spread[camera] = _spread(foreground, u, v)
            # The equations' errors are those of the pixels times the depth.
            weight[camera] = min(share, 1.0) / depth[camera] ** 2
    return pixels, weight, spread, seeing, ought


def _mean(mass: np.ndarray, along: Float[np.ndarray, "width"]) -> float:
    return float(mass.sum(axis=0) @ along / mass.sum())


def _spread(mass: np.ndarray, u: Float[np.ndarray, "width"], v: Float[np.ndarray, "height"]) -> float:
    return _mean(mass, u**2) - _mean(mass, u) ** 2 + _mean(mass.T, v**2) - _mean(mass.T, v) ** 2


def _ellipses(
    room: SearchVolume,
    position_m: Float[np.ndarray, "frames drones 3"],
    size_m: Float[np.ndarray, "drones 3"],
) -> tuple[Float[np.ndarray, "frames drones cameras 2"], Float[np.ndarray, "frames drones cameras 2"]]:
    """Middles and half axes in cells of the silhouettes; NaN where there is no drone, or it is behind the camera."""
    if not len(size_m):
        none = np.empty((len(position_m), 0, len(room.viewpoint), 2))
        return none, none
    boxes = _boxes(room.cameras, size_m, position_m)
    unseen = ~np.asarray(boxes.in_front)
    middle = np.stack([boxes.x_middle, boxes.y_middle], axis=-1).astype(np.float64) / room.reduction
    half = np.stack([boxes.x_half, boxes.y_half], axis=-1).astype(np.float64) / room.reduction
    middle[unseen], half[unseen] = np.nan, np.nan
    return middle, half


@jax.jit
def _boxes(
    cameras: Camera, size_m: Float[jax.Array, "drones 3"], position_m: Float[jax.Array, "frames drones 3"]
) -> Boxes:
    return project_boxes(make_extents(cameras, size_m), position_m)


def _meets(
    middle: Float[np.ndarray, "*drones 2"], half: Float[np.ndarray, "*drones 2"], shape: tuple[int, ...]
) -> Bool[np.ndarray, "*drones"]:
    """Whether ellipses reach into images of this shape; not a number does not."""
    return ((middle + half > 0) & (middle - half < (shape[2], shape[1]))).all(axis=-1)

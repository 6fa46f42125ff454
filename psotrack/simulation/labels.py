"""Labels of the frames: visible masks of the drones, and detections of a simulated network.

Masks are drawn in the middle of an exposure, in windows around the drones, one sample per pixel. Detections follow a
model of the errors of a YOLO network, applied to the visible parts of the drones: the quality of a drone in an image is
(1 - (1 - v)^2) (1 - exp(-(s / s0)^2)), with its visible share v and its size s. The quality sets the rate of missed
detections and the confidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from psotrack.recordings import Detections
from psotrack.simulation.imaging import raster
from psotrack.simulation.imaging.lens_image import LensImage
from psotrack.simulation.scene import Scene
from psotrack.simulation.world.drones import disc_fans

#: Margin of a window around its drone, pixels.
_MARGIN_PX = 1


@dataclass(frozen=True)
class Silhouette:
    """One drone in one image, in the middle of the exposure; rotor discs belong to the drone.

    Attributes:
        number: number of the drone, from 1.
        window: part of the image that contains the drone.
        seen: (rows, columns) of the window, True at the pixels where the drone is visible.
        whole_px: number of pixels that the drone would have without occlusion and without the edges of the image.
    """

    number: int
    window: raster.RasterView
    seen: Bool[np.ndarray, "rows columns"]
    whole_px: int

    @property
    def seen_share(self) -> float:
        """Visible share of the drone, 0 to 1."""
        return np.count_nonzero(self.seen) / self.whole_px if self.whole_px else 0.0

    @property
    def xyxy(self) -> Box | None:
        """(4,), box of the visible part, in the convention of `psotrack.geometry.boxes`; None if nothing is visible."""
        rows, columns = (np.flatnonzero(self.seen.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return None
        x, y = self.window.x, self.window.y
        return np.array([x + columns[0], y + rows[0], x + columns[-1] + 1.0, y + rows[-1] + 1.0])

    def mask(self) -> Bool[np.ndarray, "height width"]:
        """(height, width), True at the pixels of the whole image where the drone is visible."""
        whole = np.zeros((self.window.cam.height, self.window.cam.width), bool)
        whole[self.window.slices] = self.seen
        return whole


def silhouettes(
    scene: Scene, cam: raster.Pinhole, backdrop_depth_m: raster.Depth, frame: int
) -> list[Silhouette]:
    """Silhouettes of the drones within a camera's image, ordered by number; a silhouette may be fully occluded.

    Args:
        scene: the scene.
        cam: the camera.
        backdrop_depth_m: (height, width), depth of the room, which may hide drones.
        frame: number of the frame.
    """
    time_s = scene.time_s(frame)
    drawn = [_draw_alone(scene, cam, drone, time_s) for drone in range(len(scene.flights))]
    nearest_m, owner = backdrop_depth_m.copy(), np.zeros(backdrop_depth_m.shape, np.int32)
    in_image = [each for each in drawn if each is not None]
    for alone, depth_m in in_image:
        window = alone.window.slices
        is_front = alone.seen & (depth_m < nearest_m[window])
        nearest_m[window][is_front] = depth_m[is_front]
        owner[window][is_front] = alone.number
    return [replace(alone, seen=owner[alone.window.slices] == alone.number) for alone, _ in in_image]


def lens_silhouettes(
    scene: Scene,
    cam: raster.Pinhole,
    lens: LensImage,
    backdrops_depth_m: Sequence[Float[np.ndarray, "_ _"]],
    frame: int,
) -> list[Silhouette]:
    """Silhouettes of the drones in the image of a lens with distortion, as from `silhouettes`.

    Args:
        scene: the scene.
        cam: the camera without its distortion.
        lens: the image of the lens.
        backdrops_depth_m: for each face of the lens (height, width), depth of the room.
        frame: number of the frame.
    """
    by_face = [
        {drone.number: drone for drone in silhouettes(scene, face, depth_m, frame)}
        for face, depth_m in zip(lens.faces, backdrops_depth_m, strict=True)
    ]
    found = []
    for number in sorted(set().union(*by_face)):
        masks, share, whole_px = [], 0.0, 0
        for drones, face, used in zip(by_face, lens.faces, lens.used, strict=True):
            drone = drones.get(number)
            mask = np.zeros((face.height, face.width), bool) if drone is None else drone.mask() & used
            masks.append(mask.astype(np.uint8))
            if drone is not None and drone.whole_px:
                share += np.count_nonzero(mask) / drone.whole_px
                whole_px = max(whole_px, drone.whole_px)
        whole = lens.assemble(masks, cv2.INTER_NEAREST)
        x, y, width, height = cv2.boundingRect(whole)
        window = raster.RasterView(cam, x, y, width, height)
        seen = whole[window.slices].astype(bool)
        if share > 0:
            # The lens changes the area of the whole drone as it changes the area of the visible part.
            whole_px = round(np.count_nonzero(seen) / min(share, 1.0))
        found.append(Silhouette(number, window, seen, whole_px))
    return found


def _draw_alone(
    scene: Scene, cam: raster.Pinhole, drone: int, time_s: float
) -> tuple[Silhouette, raster.Depth] | None:
    """The silhouette of a drone that nothing hides, and its depth in the window; None outside the image."""
    shape, flight, at = scene.models[drone], scene.flights[drone], np.array([time_s])
    triangles = np.concatenate([shape.triangles_m, disc_fans(shape)])
    triangles = triangles @ flight.rotation(at)[0].T + flight.position_m(at)[0]
    points = triangles.reshape(-1, 3)
    window = raster.enclosing_window(raster.full_view(cam), points, _MARGIN_PX)
    if window is None:
        return None
    beyond = window
    if (points @ cam.R[2] + cam.t_m[2]).min() > raster.NEAR_M:
        # Parts of the drone outside the image count as hidden.
        around = raster.RasterView(cam, -cam.width // 2, -cam.height // 2, 2 * cam.width, 2 * cam.height)
        beyond = raster.enclosing_window(around, points, _MARGIN_PX) or window
    colour, depth_m = raster.empty_buffers(beyond)
    raster.draw(beyond, triangles, np.ones((len(triangles), 1, 3)), colour, depth_m)
    covered = colour[..., 0] > 0.5
    part = window.slices_in(beyond)
    alone = Silhouette(drone + 1, window, covered[part], int(np.count_nonzero(covered)))
    return alone, depth_m[part]


#: Size s0: 63 % of boxes of 10 px are found, and 98 % of boxes of 20 px.
_SMALL_PX = 10.0
#: Smallest confidence of a detection. The confidence above this value has a beta distribution.
_LEAST_CONFIDENCE = 0.25
#: Means of the beta distribution at quality 0 and 1, and the sum of its two parameters.
_BETA_MEANS, _BETA_SUM = (0.1, 0.9), 20.0
#: Range of the sides of a second box, relative to the first box, and factor of its quality. The second box is smaller,
#: because non-maximum suppression would remove a box with a large overlap.
_DOUBLE_SIDES, _DOUBLE_QUALITY = (0.4, 0.65), 0.4
#: Width of a false alarm in an image without drones, relative to the image's width, and standard deviation of the
#: logarithm of a false alarm's size.
_FALSE_WIDTH, _FALSE_SPREAD = 1 / 25, 0.3
#: Last number of the random seed of the detector; the sensor uses 1 to 4.
_FOR_DETECTOR = 21

Box = Float[np.ndarray, "4"]


@dataclass(frozen=True)
class _Target:
    """A box that can be detected, with its quality from 0 to 1."""

    xyxy: Box
    quality: float


def detect(scene: Scene, camera_index: int, frame: int, seen: Sequence[Silhouette]) -> Detections:
    """Detections in one frame of a camera, in descending order of confidence, with edges rounded to 0.01 px.

    The detections depend only on the silhouettes, the scenario's `detector`, and (seed, camera, frame).

    Args:
        scene: the scene, with the settings of the detector and the seed.
        camera_index: index of the camera in the rig.
        frame: number of the frame.
        seen: silhouettes in this frame, from `silhouettes`.
    """
    settings = scene.scenario.detector
    size_wh = np.asarray(scene.rig.cameras.image_size_wh[camera_index])
    rng = np.random.default_rng([scene.seed, camera_index, frame, _FOR_DETECTOR])
    targets = _targets(seen)
    boxes, confidences = [], []
    for target in _merge_overlapping(targets, settings.merge_iou):
        if rng.random() >= (1 - settings.miss_rate) * target.quality:
            continue
        box = _add_jitter(rng, target.xyxy, settings.jitter)
        boxes.append(box)
        confidences.append(_confidence(rng, target.quality * iou(box, target.xyxy)))
        if rng.random() < settings.double_rate:
            boxes.append(_second_box(rng, box))
            confidences.append(_confidence(rng, _DOUBLE_QUALITY * target.quality))
    for _ in range(rng.poisson(settings.false_alarms_per_frame)):
        boxes.append(_false_alarm(rng, targets, size_wh))
        confidences.append(_confidence(rng, 0.0))
    # Boxes are clipped to the image, and those that are less than a pixel wide or high left out.
    xyxy = np.clip(np.array(boxes).reshape(-1, 4), 0.0, np.tile(size_wh, 2)).round(2)
    confidence = np.array(confidences)
    kept = np.flatnonzero(((xyxy[:, 2:] - xyxy[:, :2]) >= 1.0).all(axis=1))
    kept = kept[np.argsort(-confidence[kept], kind="stable")]
    return Detections(np.full(len(kept), frame), xyxy[kept], confidence[kept].round(4))


def iou(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    shared = float(np.prod(np.maximum(sides, 0.0)))
    union = np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared
    return shared / float(union) if union > 0 else 0.0


def _targets(seen: Sequence[Silhouette]) -> list[_Target]:
    targets = []
    for silhouette in seen:
        box = silhouette.xyxy
        if box is not None:
            size_px = np.sqrt(np.prod(box[2:] - box[:2]))
            visibility = 1 - (1 - silhouette.seen_share) ** 2
            targets.append(_Target(box, float(visibility * -np.expm1(-((size_px / _SMALL_PX) ** 2)))))
    return targets


def _merge_overlapping(targets: list[_Target], merge_iou: float) -> list[_Target]:
    """Merge pairs of targets until no two boxes have an overlap above `merge_iou`."""
    for i, target in enumerate(targets):
        for j in range(i + 1, len(targets)):
            other = targets[j]
            if iou(target.xyxy, other.xyxy) > merge_iou:
                lower = np.minimum(target.xyxy[:2], other.xyxy[:2])
                upper = np.maximum(target.xyxy[2:], other.xyxy[2:])
                both = _Target(np.concatenate([lower, upper]), max(target.quality, other.quality))
                return _merge_overlapping(
                    [both, *targets[:i], *targets[i + 1 : j], *targets[j + 1 :]], merge_iou
                )
    return targets


def _add_jitter(rng: np.random.Generator, box: Box, jitter: float) -> Box:
    size = box[2:] - box[:2]
    middle = (box[:2] + box[2:]) / 2 + jitter * size * rng.standard_normal(2)
    half = size / 2 * np.exp(jitter * rng.standard_normal(2))
    return np.concatenate([middle - half, middle + half])


def _second_box(rng: np.random.Generator, box: Box) -> Box:
    size = box[2:] - box[:2]
    inner = size * rng.uniform(*_DOUBLE_SIDES, 2)
    corner = box[:2] + (size - inner) * rng.random(2)
    return np.concatenate([corner, corner + inner])


def _false_alarm(rng: np.random.Generator, targets: list[_Target], size_wh: Float[np.ndarray, "2"]) -> Box:
    """Box of about a drone's size at a random place in the image."""
    if targets:
        model = targets[rng.integers(len(targets))].xyxy
        size = model[2:] - model[:2]
    else:
        size = np.full(2, _FALSE_WIDTH * size_wh[0])
    size = np.minimum(size * np.exp(_FALSE_SPREAD * rng.standard_normal(2)), size_wh)
    corner = (size_wh - size) * rng.random(2)
    return np.concatenate([corner, corner + size])


def _confidence(rng: np.random.Generator, quality: float) -> float:
    low, high = _BETA_MEANS
    mean = low + (high - low) * quality
    share = rng.beta(_BETA_SUM * mean, _BETA_SUM * (1 - mean))
    return _LEAST_CONFIDENCE + (1 - _LEAST_CONFIDENCE) * share

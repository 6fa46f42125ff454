"""Simulated detections: a model of the errors of a YOLO network, applied to the visible parts of the drones.

The quality of a drone in an image is (1 - (1 - v)^2) (1 - exp(-(s / s0)^2)), with its visible share v and its size s.
The quality sets the rate of missed detections and the confidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.recordings import Detections
from psotrack.simulation.labels.masks import Silhouette
from psotrack.simulation.scene import Scene

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
        seen: silhouettes in this frame, from `labels.masks.silhouettes`.
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
    return _clip_to_image(frame, np.array(boxes).reshape(-1, 4), np.array(confidences), size_wh)


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


def _clip_to_image(
    frame: int,
    xyxy: Float[np.ndarray, "boxes 4"],
    confidence: Float[np.ndarray, "boxes"],
    size_wh: Float[np.ndarray, "2"],
) -> Detections:
    """Detections with boxes clipped to the image, without boxes that are less than a pixel wide or high."""
    xyxy = np.clip(xyxy, 0.0, np.tile(size_wh, 2)).round(2)
    kept = np.flatnonzero(((xyxy[:, 2:] - xyxy[:, :2]) >= 1.0).all(axis=1))
    kept = kept[np.argsort(-confidence[kept], kind="stable")]
    return Detections(np.full(len(kept), frame), xyxy[kept], confidence[kept].round(4))

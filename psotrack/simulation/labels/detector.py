"""Detections as a network of the YOLO family makes them: a model of its noise, applied to what is really seen.

A drone's quality is how well it can be detected: 1 - (1 - v)^2 of the share v of it that is seen, times
1 - exp(-(s / s0)^2) of its size s. It sets how often the drone is found and how sure the detector is of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.recordings import Detections
from psotrack.simulation.labels.masks import Silhouette
from psotrack.simulation.scene import Scene

#: s0: boxes of 10 px are found two times in three, those of 20 px 98 times in 100.
_SMALL_PX = 10.0
#: What a detector leaves out below; its sureness above that is of a beta distribution.
_LEAST_CONFIDENCE = 0.25
#: Mean of that distribution at quality 0 and 1, and how narrow it is (the sum of its two parameters).
_SURENESS, _NARROWNESS = (0.1, 0.9), 20.0
#: A second box lies on part of the drone, or it would have been taken for the first: its sides, relative.
_DOUBLE_SIDES, _DOUBLE_QUALITY = (0.4, 0.65), 0.4
#: Width of a false alarm where no drone is seen to take it from, relative to the image's; how sizes differ.
_FALSE_WIDTH, _FALSE_SPREAD = 1 / 25, 0.3
#: What random numbers are for; the sensor has 1 to 4.
_FOR_DETECTOR = 21

Box = Float[np.ndarray, "4"]


@dataclass(frozen=True)
class _Target:
    """What can be detected, and how well, 0 to 1."""

    xyxy: Box
    quality: float


def detect(scene: Scene, camera_index: int, frame: int, seen: Sequence[Silhouette]) -> Detections:
    """The boxes that a detector finds in one frame of a camera, the surest first, with edges to 0.01 px.

    They depend on what is seen, the scenario's `detector`, and (seed, camera, frame) alone.

    Args:
        scene: for its settings and its seed.
        camera_index: of the rig.
        frame: its number.
        seen: of `labels.masks.silhouettes`.
    """
    settings = scene.scenario.detector
    size_wh = np.asarray(scene.rig.cameras.image_size_wh[camera_index])
    rng = np.random.default_rng([scene.seed, camera_index, frame, _FOR_DETECTOR])
    targets = _targets(seen)
    boxes, confidences = [], []
    for target in _merged(targets, settings.merge_iou):
        if rng.random() >= (1 - settings.miss_rate) * target.quality:
            continue
        box = _jittered(rng, target.xyxy, settings.jitter)
        boxes.append(box)
        confidences.append(_confidence(rng, target.quality * iou(box, target.xyxy)))
        if rng.random() < settings.double_rate:
            boxes.append(_part(rng, box))
            confidences.append(_confidence(rng, _DOUBLE_QUALITY * target.quality))
    for _ in range(rng.poisson(settings.false_alarms_per_frame)):
        boxes.append(_false_alarm(rng, targets, size_wh))
        confidences.append(_confidence(rng, 0.0))
    return _in_image(frame, np.array(boxes).reshape(-1, 4), np.array(confidences), size_wh)


def iou(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    shared = float(np.prod(np.maximum(sides, 0.0)))
    union = np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared
    return shared / float(union) if union > 0 else 0.0


def _targets(seen: Sequence[Silhouette]) -> list[_Target]:
    targets = []
    for one in seen:
        box = one.xyxy
        if box is not None:
            size_px = np.sqrt(np.prod(box[2:] - box[:2]))
            in_sight = 1 - (1 - one.seen_share) ** 2
            targets.append(_Target(box, float(in_sight * -np.expm1(-((size_px / _SMALL_PX) ** 2)))))
    return targets


def _merged(targets: list[_Target], merge_iou: float) -> list[_Target]:
    """Targets whose boxes overlap more than `merge_iou` made one, as long as there are any."""
    for i, one in enumerate(targets):
        for j in range(i + 1, len(targets)):
            other = targets[j]
            if iou(one.xyxy, other.xyxy) > merge_iou:
                corners = np.minimum(one.xyxy[:2], other.xyxy[:2]), np.maximum(one.xyxy[2:], other.xyxy[2:])
                both = _Target(np.concatenate(corners), max(one.quality, other.quality))
                return _merged([both, *targets[:i], *targets[i + 1 : j], *targets[j + 1 :]], merge_iou)
    return targets


def _jittered(rng: np.random.Generator, box: Box, jitter: float) -> Box:
    size = box[2:] - box[:2]
    middle = (box[:2] + box[2:]) / 2 + jitter * size * rng.standard_normal(2)
    half = size / 2 * np.exp(jitter * rng.standard_normal(2))
    return np.concatenate([middle - half, middle + half])


def _part(rng: np.random.Generator, box: Box) -> Box:
    size = box[2:] - box[:2]
    inner = size * rng.uniform(*_DOUBLE_SIDES, 2)
    corner = box[:2] + (size - inner) * rng.random(2)
    return np.concatenate([corner, corner + inner])


def _false_alarm(rng: np.random.Generator, targets: list[_Target], size_wh: Float[np.ndarray, "2"]) -> Box:
    """A box of a drone's size anywhere in the image."""
    if targets:
        like = targets[rng.integers(len(targets))].xyxy
        size = like[2:] - like[:2]
    else:
        size = np.full(2, _FALSE_WIDTH * size_wh[0])
    size = np.minimum(size * np.exp(_FALSE_SPREAD * rng.standard_normal(2)), size_wh)
    corner = (size_wh - size) * rng.random(2)
    return np.concatenate([corner, corner + size])


def _confidence(rng: np.random.Generator, quality: float) -> float:
    low, high = _SURENESS
    mean = low + (high - low) * quality
    sureness = rng.beta(_NARROWNESS * mean, _NARROWNESS * (1 - mean))
    return _LEAST_CONFIDENCE + (1 - _LEAST_CONFIDENCE) * sureness


def _in_image(
    frame: int,
    xyxy: Float[np.ndarray, "boxes 4"],
    confidence: Float[np.ndarray, "boxes"],
    size_wh: Float[np.ndarray, "2"],
) -> Detections:
    """Boxes cut at the image's edges, those with less than a pixel left dropped."""
    xyxy = np.clip(xyxy, 0.0, np.tile(size_wh, 2)).round(2)
    kept = np.flatnonzero(((xyxy[:, 2:] - xyxy[:, :2]) >= 1.0).all(axis=1))
    kept = kept[np.argsort(-confidence[kept], kind="stable")]
    return Detections(np.full(len(kept), frame), xyxy[kept], confidence[kept].round(4))

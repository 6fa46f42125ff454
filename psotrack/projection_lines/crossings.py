"""One frame: assignment of detections to drones, and the crossings of their lines of sight."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.correspondence import CUT_SHARE, CameraSightings, match
from psotrack.geometry import Camera, reconstruct, sizes_m, to_camera

#: Least standard deviation of a detection's middle, pixels, however well the cameras agree.
LEAST_NOISE_PX = 0.1
#: Additional standard deviation of a middle, as a share of the box's sides, where several drones share the box: all but
#: one are hidden. The value is that of boxes that the image's border cuts.
SHARED_SHARE = CUT_SHARE


@dataclass(frozen=True)
class Crossings:
    """Positions where lines of sight of one drone's detections cross.

    Attributes:
        expected: (crossings,), index of the expected drone; -1 where no drone was expected.
        position_m: (crossings, 3), metres.
        covariance_m2: (crossings, 3, 3), from the noise of the detections.
        seen: (crossings, cameras), cameras whose detections count.
        box: (crossings, cameras), which of the camera's boxes counts; -1 for none.
        disagreement: (crossings,), squared reprojection errors over the noise, per degree of freedom: about 1 where the
            noise is right.
        span_m: (crossings, 2), width and height of the detections at that distance, median of the cameras, metres.
    """

    expected: Int[np.ndarray, "crossings"]
    position_m: Float[np.ndarray, "crossings 3"]
    covariance_m2: Float[np.ndarray, "crossings 3 3"]
    seen: Bool[np.ndarray, "crossings cameras"]
    box: Int[np.ndarray, "crossings cameras"]
    disagreement: Float[np.ndarray, "crossings"]
    span_m: Float[np.ndarray, "crossings 2"]

    def joined(self, other: Crossings, num_expected: int) -> Crossings:
        """The crossings of both.

        Args:
            other: crossings of other expected drones.
            num_expected: number of the drones that were expected here; those of the other follow them.
        """
        values = {
            each.name: np.concatenate([getattr(self, each.name), getattr(other, each.name)])
            for each in fields(self)
        }
        known = np.where(other.expected >= 0, other.expected + num_expected, -1)
        return Crossings(**values | {"expected": np.concatenate([self.expected, known])})


def crossings(
    cameras: Camera,
    view: CameraSightings,
    bounds_m: Float[np.ndarray, "2 3"],
    expected_m: Float[np.ndarray, "drones 3"],
    expected_covariance_m2: Float[np.ndarray, "drones 3 3"],
    dispersion: Float[np.ndarray, "drones"],
    min_views: int | None = None,
) -> Crossings:
    """Match the detections of all cameras, and triangulate each group without the views that disagree.

    Args:
        cameras: cameras with one leading axis.
        view: detections of the frame.
        bounds_m: (2, 3), corners of the room, metres.
        expected_m, expected_covariance_m2: (drones, 3) and (drones, 3, 3), expected positions and their covariances.
        dispersion: (drones,), ratio of the variance of each drone's detections so far and `view.noise_px`².
        min_views: smallest number of viewpoints of a drone that was not expected (see `match`).
    """
    # Detections of an unexpected drone have the same noise as detections of known drones.
    dispersion = np.append(dispersion, np.median(dispersion) if len(dispersion) else 1.0)
    # At least the stated noise is used for matching: the groups are judged after they are triangulated.
    scale = np.sqrt(max(1.0, dispersion[-1]))
    groups = match(
        cameras,
        view.found(view.centre_px),
        [scale * noise_px for noise_px in view.found(view.noise_px)],
        bounds_m=bounds_m,
        min_views=min_views,
        expected_m=expected_m,
        expected_covariance_m2=expected_covariance_m2,
    )
    centre_px, size_px, noise_px = (
        view.grouped(values, groups.detection) for values in (view.centre_px, view.size_px, view.noise_px)
    )
    several = _shared(groups.detection)
    hidden_px = np.where(several, SHARED_SHARE * np.sqrt(size_px.prod(axis=-1)), 0.0)
    noise_px = np.hypot(noise_px, hidden_px)
    # The dispersion of a drone alone in its box says nothing about a box that it shares.
    usual = np.where(several, 1.0, np.sqrt(dispersion[groups.expected])[:, None])
    known_px = np.maximum(noise_px * usual, LEAST_NOISE_PX)
    if view.exposures is not None:
        # A frame that several instants show counts once in all of them together.
        known_px = known_px / np.sqrt(np.maximum(view.exposures.share, 1e-6))
    lines = reconstruct(cameras, centre_px, noise_px=np.nan_to_num(known_px, nan=1.0))
    kept = lines.used.any(axis=-1)
    position_m, seen = lines.position_m[kept], lines.used[kept]
    squared = np.where(seen, lines.reprojection_px[kept] / noise_px[kept], 0.0) ** 2
    span_m = sizes_m(cameras, np.asarray(to_camera(cameras, position_m[:, None])), size_px[kept])
    span_m = np.where(seen[..., None], span_m, np.nan)
    return Crossings(
        expected=groups.expected[kept],
        position_m=position_m,
        covariance_m2=lines.covariance_m2[kept],
        seen=seen,
        box=_boxes(view, groups.detection[kept]),
        disagreement=squared.sum(axis=-1) / (2 * seen.sum(axis=-1) - 3),
        span_m=np.nanmedian(span_m, axis=1),
    )


def _boxes(
    view: CameraSightings, detection: Int[np.ndarray, "groups cameras"]
) -> Int[np.ndarray, "groups cameras"]:
    """Places among the boxes of detections that are counted without padding; -1 for none."""
    boxes = np.full(detection.shape, -1)
    for camera, noise_px in enumerate(view.noise_px):
        there = detection[:, camera] >= 0
        boxes[there, camera] = np.flatnonzero(np.isfinite(noise_px))[detection[there, camera]]
    return boxes


def _shared(detection: Int[np.ndarray, "groups cameras"]) -> Bool[np.ndarray, "groups cameras"]:
    """(groups, cameras), whether several groups share the detection."""
    return ((detection[:, None] == detection) & (detection >= 0)).sum(axis=1) > 1

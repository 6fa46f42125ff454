"""One frame: assignment of detections to drones, and the crossings of their lines of sight."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import Camera, reconstruct, sizes_m, to_camera, viewpoints
from psotrack.tracking.matching.matching import match
from psotrack.tracking.matching.sightings import CUT_SHARE, Sightings

#: Least standard deviation of a detection's middle, pixels, however well the cameras agree.
LEAST_NOISE_PX = 0.1
#: Additional standard deviation of a middle, as a share of the box's sides, where several drones share the box: all but
#: one are hidden. The value is that of boxes that the image's border cuts.
SHARED_SHARE = CUT_SHARE
#: A box whose longer side is larger by this factor than those of the drone's other boxes holds something else too. A
#: square drone is 1.41 times as wide across its corners.
SEVERAL_SIZE = 1.5


@dataclass(frozen=True)
class Measurement:
    """What one frame alone shows of a drone.

    Attributes:
        position_m: (3,), metres.
        covariance_m2: (3, 3), of the position.
        disagreement: squared reprojection errors over the noise, per degree of freedom.
        num_cameras, num_viewpoints: cameras whose sightings count, and their viewpoints.
        span_m: (2,), width and height of the sightings at the drone's distance, metres.
        place_px, noise_px: (cameras, 2) and (cameras,), middles of the sightings that count and their standard
            deviations along each axis, pixels; NaN for other cameras.
        surprising: whether the position is too far from the expected one to be an error of measurement.
    """

    position_m: Float[np.ndarray, "3"]
    covariance_m2: Float[np.ndarray, "3 3"]
    disagreement: float
    num_cameras: int
    num_viewpoints: int
    span_m: Float[np.ndarray, "2"]
    place_px: Float[np.ndarray, "cameras 2"]
    noise_px: Float[np.ndarray, "cameras"]
    surprising: bool = False


@dataclass(frozen=True)
class Crossings:
    """Positions where lines of sight of one drone's detections cross.

    Attributes:
        expected: (crossings,), index of the expected drone; -1 where no drone was expected.
        position_m: (crossings, 3), metres.
        covariance_m2: (crossings, 3, 3), from the noise of the detections.
        seen: (crossings, cameras), cameras whose detections count.
        num_viewpoints: (crossings,), viewpoints of these cameras.
        box: (crossings, cameras), which of the camera's boxes counts; -1 for none.
        disagreement: (crossings,), squared reprojection errors over the noise, per degree of freedom: about 1 where the
            noise is right.
        span_m: (crossings, 2), width and height of the detections at that distance, median of the cameras, metres.
        span_ratio: (crossings,), ratio of the cameras' largest and smallest spans, each its longer side.
        place_px, noise_px: (crossings, cameras, 2) and (crossings, cameras), middles of the detections that count and
            their standard deviations, pixels; NaN for other cameras.
        ambiguity: (crossings,), likelihood of another assignment of the detections (see `Matches`).
    """

    expected: Int[np.ndarray, "crossings"]
    position_m: Float[np.ndarray, "crossings 3"]
    covariance_m2: Float[np.ndarray, "crossings 3 3"]
    seen: Bool[np.ndarray, "crossings cameras"]
    num_viewpoints: Int[np.ndarray, "crossings"]
    box: Int[np.ndarray, "crossings cameras"]
    disagreement: Float[np.ndarray, "crossings"]
    span_m: Float[np.ndarray, "crossings 2"]
    span_ratio: Float[np.ndarray, "crossings"]
    place_px: Float[np.ndarray, "crossings cameras 2"]
    noise_px: Float[np.ndarray, "crossings cameras"]
    ambiguity: Float[np.ndarray, "crossings"]

    def measurement(self, row: int) -> Measurement:
        """What one crossing shows."""
        return Measurement(
            self.position_m[row],
            self.covariance_m2[row],
            float(self.disagreement[row]),
            int(self.seen[row].sum()),
            int(self.num_viewpoints[row]),
            self.span_m[row],
            self.place_px[row],
            self.noise_px[row],
        )

    def numbered(self, drones: Int[np.ndarray, "expected"]) -> Crossings:
        """The crossings with other numbers for the expected drones."""
        expected = np.append(drones, -1)[self.expected]
        return replace(self, expected=expected)

    def joined(self, other: Crossings) -> Crossings:
        """The crossings of both."""
        both = zip(vars(self).values(), vars(other).values(), strict=True)
        return Crossings(*map(np.concatenate, both))


@dataclass(frozen=True)
class Expected:
    """Where drones are expected.

    Attributes:
        position_m, covariance_m2: (drones, 3) and (drones, 3, 3), positions and their covariances, metres.
        dispersion: (drones,), ratio of the variance of each drone's detections so far and the stated variance.
        usual_dispersion: the ratio where no drone is expected.
    """

    position_m: Float[np.ndarray, "drones 3"]
    covariance_m2: Float[np.ndarray, "drones 3 3"]
    dispersion: Float[np.ndarray, "drones"]
    usual_dispersion: float = 1.0

    @property
    def usual(self) -> float:
        """The ratio for detections of a drone that is not expected: the same noise as that of the known drones."""
        return float(np.median(self.dispersion)) if len(self.dispersion) else self.usual_dispersion


def crossings(
    cameras: Camera,
    view: Sightings,
    bounds_m: Float[np.ndarray, "2 3"],
    drones: Expected,
    min_views: int | None = None,
) -> Crossings:
    """Match the detections of all cameras, and triangulate each group without the views that disagree.

    Args:
        cameras: cameras with one leading axis.
        view: detections of the frame.
        bounds_m: (2, 3), corners of the room, metres.
        drones: where drones are expected.
        min_views: smallest number of viewpoints of a drone that was not expected (see `match`).
    """
    dispersion = np.append(drones.dispersion, drones.usual)
    # At least the stated noise is used for matching: the groups are judged after they are triangulated.
    scale = np.sqrt(max(1.0, dispersion[-1]))
    groups = match(
        cameras,
        view.centre_px,
        scale * view.noise_px,
        bounds_m=bounds_m,
        min_views=min_views,
        expected=(drones.position_m, drones.covariance_m2),
    )
    shown = view.grouped(groups.detection)
    centre_px, size_px = shown.centre_px, shown.size_px
    several = ((groups.detection[:, None] == groups.detection) & (groups.detection >= 0)).sum(axis=1) > 1
    hidden_px = np.where(several, SHARED_SHARE * np.sqrt(size_px.prod(axis=-1)), 0.0)
    noise_px = np.hypot(shown.noise_px, hidden_px)
    # The dispersion of a drone alone in its box says nothing about a box that it shares.
    scale = np.where(several, 1.0, np.sqrt(dispersion[groups.expected])[:, None])
    known_px = np.maximum(noise_px * scale, LEAST_NOISE_PX)
    if view.exposures is not None:
        # A frame that several instants show counts once in all of them together.
        known_px = known_px / np.sqrt(np.maximum(view.exposures.share, 1e-6))
    lines = reconstruct(cameras, centre_px, noise_px=np.nan_to_num(known_px, nan=1.0))
    surplus_px = _surplus_px(cameras, lines.position_m, size_px)
    if surplus_px.any():
        noise_px, known_px = np.hypot(noise_px, surplus_px), np.hypot(known_px, surplus_px)
        lines = reconstruct(cameras, centre_px, noise_px=np.nan_to_num(known_px, nan=1.0))
    kept, label = lines.used.any(axis=-1), viewpoints(cameras)
    position_m, seen = lines.position_m[kept], lines.used[kept]
    squared = np.where(seen, lines.reprojection_px[kept] / noise_px[kept], 0.0) ** 2
    span_m = sizes_m(cameras, np.asarray(to_camera(cameras, position_m[:, None])), size_px[kept])
    span_m = np.where(seen[..., None], span_m, np.nan)
    longer_m = span_m.max(axis=-1)
    return Crossings(
        expected=groups.expected[kept],
        position_m=position_m,
        covariance_m2=lines.covariance_m2[kept],
        seen=seen,
        num_viewpoints=(seen @ (label[:, None] == np.arange(len(label)))).sum(axis=-1),
        box=groups.detection[kept],
        disagreement=squared.sum(axis=-1) / (2 * seen.sum(axis=-1) - 3),
        span_m=_median(span_m),
        span_ratio=np.fmax.reduce(longer_m, axis=1) / np.fmin.reduce(longer_m, axis=1),
        place_px=np.where(seen[..., None], centre_px[kept], np.nan),
        noise_px=np.where(seen, noise_px[kept], np.nan),
        ambiguity=groups.ambiguity[kept],
    )


def _surplus_px(
    cameras: Camera,
    position_m: Float[np.ndarray, "groups 3"],
    size_px: Float[np.ndarray, "groups cameras 2"],
) -> Float[np.ndarray, "groups cameras"]:
    """By how much the middle of a box may be off that holds more than the drone; 0 for boxes of usual size.

    A box that is much larger than the drone's other boxes is that of several drones in one blob.
    """
    points_cam = np.asarray(to_camera(cameras, position_m[:, None]))
    span_m = sizes_m(cameras, points_cam, size_px).max(axis=-1)
    ratio = span_m / _median(span_m)[:, None]
    return np.where(ratio > SEVERAL_SIZE, size_px.max(axis=-1) * (1 - 1 / ratio) / 2, 0.0)


def _median(values: Float[np.ndarray, "groups cameras *rest"]) -> Float[np.ndarray, "groups *rest"]:
    """Medians of the cameras that are not NaN; of few values, `np.nanmedian` takes ten times as long."""
    ordered, count = np.sort(values, axis=1), (~np.isnan(values)).sum(axis=1, keepdims=True)
    middles = np.concatenate([(count - 1) // 2, count // 2], axis=1)
    return np.take_along_axis(ordered, middles, axis=1).mean(axis=1)

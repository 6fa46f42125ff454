"""Flights by a formula, and the detections that cameras give of them, without any image.

A drone flies a sum of sines at a chosen mean speed. Each camera gives boxes about the drones' projections with errors
of 1 to 2 pixels, of which half lasts for some frames. One box in ten is missing, false alarms come at random places and
from birds, posts hide drones, and drones that overlap in an image have one box. The code shares nothing with the
tracker but the projection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.geometry import Rig, look_at, make_camera, make_rig, project
from psotrack.recordings import Detections
from psotrack.trajectories import Trajectories

IMAGE_SIZE_WH = (1920, 1080)
FPS = 25.0
#: Time constant of the part of a box's error that lasts, seconds.
ERROR_TIME_S = 0.4
#: Share of the boxes that are missing, and mean number of false ones in an image.
MISSED, FALSE_ALARMS = 0.1, 0.3
#: Boxes that overlap more than this (intersection over union) are one box.
MERGED_IOU = 0.3


@dataclass(frozen=True)
class Scene:
    """A rig and a volume in which drones fly.

    Attributes:
        num_cameras: number of cameras in the ring.
        radius_m, height_m: radius of the ring, and height of the cameras, metres.
        centre_m: middle of the volume, at which the cameras look, metres.
        reach_m: half lengths of the volume, metres.
        speed_m_s: lowest and highest mean speed of a drone.
        num_drones: number of drones.
        size_m: width and height of a drone, metres.
        focal_px: focal length, pixels.
    """

    num_cameras: int
    radius_m: float
    height_m: float
    centre_m: tuple[float, float, float]
    reach_m: tuple[float, float, float]
    speed_m_s: tuple[float, float]
    num_drones: int
    size_m: tuple[float, float] = (0.5, 0.2)
    focal_px: float = 1200.0


SCENES = {
    "indoors, 8 cameras above 4 drones": Scene(
        8, 6.0, 3.0, (0, 0, 1.3), (2.2, 2.2, 0.9), (0.5, 2), 4, (0.4, 0.15), 1000.0
    ),
    "outdoors, 4 cameras, 3 drones on 100 m": Scene(
        4, 65.0, 1.5, (0, 0, 25), (50, 50, 12), (8, 15), 3, (0.8, 0.4)
    ),
}


@dataclass(frozen=True)
class Flight:
    """A flight: its rig, its detections by camera, its truth, and frames per second."""

    rig: Rig
    detections: dict[str, Detections]
    truth: Trajectories
    fps: float = FPS

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.truth.num_frames


def ring(scene: Scene, rng: np.random.Generator) -> Rig:
    """Cameras on a circle, slightly irregular, that look at the middle of the volume."""
    angle = 2 * np.pi * np.arange(scene.num_cameras) / scene.num_cameras + rng.normal(
        0, 0.05, scene.num_cameras
    )
    K = np.array([[scene.focal_px, 0, 960.0], [0, scene.focal_px, 540.0], [0, 0, 1]])
    cameras = {}
    for number, one in enumerate(angle):
        place_m = np.array([scene.radius_m * np.cos(one), scene.radius_m * np.sin(one), scene.height_m])
        place_m = place_m * rng.normal(1, 0.03, 3)
        R, t_m = look_at(place_m.tolist(), [float(each) for each in scene.centre_m])
        cameras[f"cam{number + 1}"] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=IMAGE_SIZE_WH)
    return make_rig(cameras)


def sines(scene: Scene, num_frames: int, rng: np.random.Generator) -> Float[np.ndarray, "frames drones 3"]:
    """Positions of the drones: sums of two sines per axis, at mean speeds spread over the scene's range."""
    time_s = np.arange(num_frames) / FPS
    speed_m_s = np.linspace(*scene.speed_m_s, scene.num_drones)
    paths = []
    for mean_m_s in speed_m_s:
        phase = rng.uniform(0, 2 * np.pi, (2, 3))
        rate = rng.uniform(0.7, 1.3, (2, 3)) * np.array([[1.0], [2.0]])
        reach_m = np.array(scene.reach_m)
        size_m = np.stack([0.75 * reach_m, 0.25 * reach_m])
        # The rate at which the mean speed is the wanted one.
        fine = np.linspace(0, 60, 6001)
        flown = (
            size_m[:, None] * rate[:, None] * np.cos(rate[:, None] * fine[:, None] + phase[:, None])
        ).sum(axis=0)
        omega = mean_m_s / np.linalg.norm(flown, axis=-1).mean()
        angle = omega * rate[:, None] * time_s[:, None] + phase[:, None]
        paths.append(np.array(scene.centre_m) + (size_m[:, None] * np.sin(angle)).sum(axis=0))
    return np.stack(paths, axis=1)


def make_flight(scene: Scene, num_frames: int, seed: int) -> Flight:
    """One flight of a scene of a number of frames."""
    rng = np.random.default_rng(seed)
    rig = ring(scene, rng)
    truth_m = sines(scene, num_frames, rng)
    detections = {name: _detect(scene, rig, camera, truth_m, rng) for camera, name in enumerate(rig.names)}
    frame = np.arange(num_frames)
    names = tuple(f"dron{number + 1}" for number in range(scene.num_drones))
    seen = _in_view(rig, truth_m).sum(axis=-1) >= 2
    # Where fewer than two cameras have a drone in view, the recording does not show where it is.
    return Flight(
        rig, detections, Trajectories(frame, frame / FPS, names, np.where(seen[..., None], truth_m, np.nan))
    )


def _in_view(rig: Rig, truth_m: Float[np.ndarray, "frames drones 3"]) -> np.ndarray:
    pixels, depth = project(rig.cameras, truth_m[:, :, None])
    return np.asarray(((pixels > 0) & (pixels < rig.cameras.image_size_wh)).all(axis=-1) & (depth > 0))


def _detect(
    scene: Scene,
    rig: Rig,
    camera: int,
    truth_m: Float[np.ndarray, "frames drones 3"],
    rng: np.random.Generator,
) -> Detections:
    """Boxes of one camera in all frames."""
    pixels, depth = project(rig.cameras[camera], truth_m)
    size_px = scene.focal_px * np.array(scene.size_m) / depth[..., None]
    noise_px = rng.uniform(1.0, 2.0)
    middle = (
        pixels
        + 0.5
        + noise_px
        * (np.sqrt(0.5) * rng.standard_normal(pixels.shape) + np.sqrt(0.5) * _lasting(pixels.shape, rng))
    )
    inside = ((middle > 0) & (middle < IMAGE_SIZE_WH)).all(axis=-1) & (depth > 0)
    # A post as wide as a few drones hides what is behind it.
    post_px = rng.uniform(300, 1600)
    hidden = np.abs(pixels[..., 0] - post_px) < 1.5 * np.median(size_px[..., 0])
    kept = inside & ~hidden & (rng.random(inside.shape) >= MISSED)
    bird = _bird(len(truth_m), rng)
    frame, boxes = [], []
    for number in range(len(truth_m)):
        some = np.concatenate([middle - size_px / 2, middle + size_px / 2], axis=-1)[number, kept[number]]
        found = _merged(some.tolist())
        for _ in range(rng.poisson(FALSE_ALARMS)):
            corner = rng.random(2) * (np.array(IMAGE_SIZE_WH) - 40)
            found.append([*corner, *(corner + rng.uniform(8, 40, 2))])
        if np.isfinite(bird[number]).all():
            found.append([*(bird[number] - 8), *(bird[number] + 8)])
        frame += [number] * len(found)
        boxes += found
    return Detections(np.array(frame, int), np.array(boxes, float).reshape(-1, 4), np.ones(len(frame)))


def _lasting(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Errors of variance 1 that decay with `ERROR_TIME_S` along the first axis."""
    kept = np.exp(-1 / (FPS * ERROR_TIME_S))
    errors = rng.standard_normal(shape)
    for row in range(1, len(errors)):
        errors[row] = kept * errors[row - 1] + np.sqrt(1 - kept**2) * errors[row]
    return errors


def _bird(num_frames: int, rng: np.random.Generator) -> Float[np.ndarray, "frames 2"]:
    """A bird that only this camera sees, for a third of the time."""
    start = rng.integers(num_frames)
    at = np.arange(num_frames) - start
    place = rng.uniform(0, IMAGE_SIZE_WH, 2) + at[:, None] * rng.normal(0, 8, 2)
    seen = (
        (at >= 0)
        & (at < num_frames // 3)
        & ((place > 10) & (place < np.array(IMAGE_SIZE_WH) - 10)).all(axis=-1)
    )
    return np.where(seen[:, None], place, np.nan)


def _merged(boxes: list[list[float]]) -> list[list[float]]:
    """Boxes, with those that overlap much replaced by the box about them."""
    merged: list[list[float]] = []
    for box in boxes:
        for index, other in enumerate(merged):
            width = min(box[2], other[2]) - max(box[0], other[0])
            height = min(box[3], other[3]) - max(box[1], other[1])
            shared = max(width, 0) * max(height, 0)
            areas = [(one[2] - one[0]) * (one[3] - one[1]) for one in (box, other)]
            if shared > MERGED_IOU * (sum(areas) - shared):
                merged[index] = [*np.minimum(box[:2], other[:2]), *np.maximum(box[2:], other[2:])]
                break
        else:
            merged.append(box)
    return merged

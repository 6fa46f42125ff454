"""Rigs and recordings of boxes by formula, to judge the doctor: no video, and no code of the doctor or of the matching.

A body is a set of ellipsoids. The outline of an ellipsoid in a pinhole image is a conic, and its box has a closed form
(R. Hartley & A. Zisserman, Multiple View Geometry, 2nd edition, section 8.3). The box of the body is the smallest box
around the boxes of its ellipsoids, so the box of a lopsided body has a middle that is no fixed point of the body.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.geometry import Rig, look_at, make_camera, make_rig
from psotrack.recordings import Detections

FPS = 25.0
#: Half axes and middles of the ellipsoids of a drone, metres.
DRONE = (np.array([[0.22, 0.22, 0.06], [0.08, 0.08, 0.1]]), np.array([[0.0, 0.0, 0.02], [0.0, 0.0, -0.03]]))
#: A lopsided body, like an L with a mast.
LOPSIDED = (
    np.array([[0.3, 0.12, 0.1], [0.1, 0.3, 0.12], [0.06, 0.06, 0.35], [0.15, 0.15, 0.15]]),
    np.array([[0.15, 0.0, 0.0], [0.35, 0.25, -0.05], [-0.1, 0.05, 0.3], [-0.15, -0.3, 0.1]]),
)


@dataclass(frozen=True)
class Scene:
    """What is recorded, and how well.

    Attributes:
        cameras: number of cameras.
        outdoors: cameras on the ground and drones above, else cameras under the ceiling of a room.
        drones: number of bodies.
        lopsided: one large lopsided body in a small volume, else small drones.
        turning: whether bodies turn about the vertical axis as they fly.
        size: factor of the bodies' size.
        frames: number of frames.
        noise_px, noise_share: standard deviation of each edge of a box: pixels, plus a share of the box's side.
        lasting: share of the noise's variance that lasts for about a second.
        missed: share of boxes that are missing.
        false_alarms: mean number of false boxes per image.
        calibration_deg: standard deviation of the turn of each camera about each axis that a sound calibration has.
    """

    cameras: int = 5
    outdoors: bool = False
    drones: int = 2
    lopsided: bool = False
    turning: bool = True
    size: float = 1.0
    frames: int = 300
    noise_px: float = 0.7
    noise_share: float = 0.03
    lasting: float = 0.3
    missed: float = 0.05
    false_alarms: float = 0.1
    calibration_deg: float = 0.0


@dataclass(frozen=True)
class Flight:
    """The bodies of a scene over time.

    Attributes:
        parts: half axes and middles of a body's ellipsoids, metres.
        scale: factor of the body's size.
        phase, middle_m, reach_m, rate: parameters of the smooth paths, one row per body.
        turn_rate: turns about the vertical axis, radians per second, one per body.
    """

    parts: tuple[np.ndarray, np.ndarray]
    scale: float
    phase: np.ndarray
    middle_m: np.ndarray
    reach_m: np.ndarray
    rate: np.ndarray
    turn_rate: np.ndarray

    def at(self, time_s: Float[np.ndarray, "times"]) -> tuple[np.ndarray, np.ndarray]:
        """Positions (times, bodies, 3), and headings (times, bodies), radians."""
        angle = self.rate * time_s[:, None, None] + self.phase[..., :3]
        place = self.middle_m + self.reach_m * (0.8 * np.sin(angle) + 0.2 * np.sin(2.3 * angle + 1.0))
        heading = self.phase[..., 3] + self.turn_rate * time_s[:, None]
        return place, heading


def make_true_rig(scene: Scene, rng: np.random.Generator) -> Rig:
    """Cameras around the bodies, each with a lens of its own."""
    size = (3840, 2160) if scene.outdoors else (1920, 1080)
    cameras = {}
    start = rng.uniform(0, 2 * np.pi)
    # Some rigs stand all around, others on one side.
    arc = rng.choice([2 * np.pi, 2 * np.pi, 0.8 * np.pi])
    for index in range(scene.cameras):
        angle = start + arc * (index + rng.uniform(-0.15, 0.15)) / scene.cameras
        if scene.outdoors:
            radius, height = rng.uniform(35, 55), rng.uniform(1.0, 3.0)
            target = rng.normal((0, 0, 20.0), 2.0)
            focal = size[0] * rng.uniform(0.65, 0.8)
        else:
            radius, height = rng.uniform(3.8, 5.0), rng.uniform(2.0, 3.2)
            target = rng.normal((0, 0, 1.2), 0.15)
            focal = size[0] * rng.uniform(0.55, 0.7)
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        R, t_m = look_at(centre.tolist(), target.tolist())
        K = np.array(
            [
                [focal, 0, size[0] / 2 + rng.normal(0, 8)],
                [0, focal, size[1] / 2 + rng.normal(0, 8)],
                [0, 0, 1],
            ]
        )
        cameras[f"cam{index + 1}"] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=size)
    return make_rig(cameras)


def make_flight(scene: Scene, rng: np.random.Generator) -> Flight:
    """Smooth paths with speeds of about 1.5 m/s in a room, 8 m/s outdoors, and 0.3 m/s for a large body."""
    count = scene.drones
    unit = 10.0 if scene.outdoors else 1.3
    middle = np.zeros((count, 3))
    if scene.outdoors:
        middle[:, 2] = 20 + 5 * (np.arange(count) - (count - 1) / 2)
    else:
        middle[:, 2] = 1.2 + 0.45 * (np.arange(count) - (count - 1) / 2)
    reach = unit * np.column_stack([rng.uniform(0.7, 1.1, (count, 2)), np.full(count, 0.25)])
    rate = rng.uniform(0.7, 1.1, (count, 1)) * np.array([1.0, 1.13, 0.9])
    if scene.lopsided:
        reach *= 0.15
        rate *= 1.3
    turn_rate = rng.uniform(0.2, 0.6, count) * (1.0 if scene.turning else 0.0)
    return Flight(
        LOPSIDED if scene.lopsided else DRONE,
        scene.size,
        rng.uniform(0, 2 * np.pi, (count, 4)),
        middle,
        reach,
        rate,
        turn_rate,
    )


def exact_boxes(
    rig: Rig, index: int, flight: Flight, time_s: Float[np.ndarray, "times"]
) -> tuple[Float[np.ndarray, "times bodies 4"], Float[np.ndarray, "times bodies"]]:
    """Edges of each body's box in one camera, and the depth of the body; NaN behind the camera."""
    T, K = rig.cameras.T_cam_world[index], rig.cameras.K[index]
    P = K @ T[:3]
    half, middle = flight.parts
    place, heading = flight.at(time_s)
    cos, sin, none, one = np.cos(heading), np.sin(heading), np.zeros_like(heading), np.ones_like(heading)
    R = np.stack(
        [np.stack([cos, -sin, none], -1), np.stack([sin, cos, none], -1), np.stack([none, none, one], -1)], -2
    )
    low, high = np.full((2, *heading.shape, 2), np.nan)
    for axes, centre in zip(flight.scale * half, flight.scale * middle, strict=True):
        world = place + R @ centre
        dual = np.zeros((*heading.shape, 4, 4))
        dual[..., :3, :3] = (
            R @ np.diag(axes**2) @ R.swapaxes(-1, -2) - world[..., :, None] * world[..., None, :]
        )
        dual[..., :3, 3] = dual[..., 3, :3] = -world
        dual[..., 3, 3] = -1.0
        C = P @ dual @ P.T
        for axis in range(2):
            ratio = C[..., axis, 2] / C[..., 2, 2]
            spread = np.sqrt(np.maximum(ratio**2 - C[..., axis, axis] / C[..., 2, 2], 0.0))
            low[..., axis] = np.fmin(low[..., axis], ratio - spread)
            high[..., axis] = np.fmax(high[..., axis], ratio + spread)
    depth = place @ T[2, :3] + T[2, 3]
    boxes = np.concatenate([low, high], -1)
    return np.where(depth[..., None] > 0.5, boxes, np.nan), depth


def record(
    rig: Rig,
    flight: Flight,
    scene: Scene,
    rng: np.random.Generator,
    lag_frames: Mapping[str, float] | None = None,
) -> dict[str, Detections]:
    """Detections of all cameras.

    Args:
        rig: the true cameras.
        flight: the bodies.
        scene: numbers of the detector.
        rng: random numbers.
        lag_frames: by camera, by how many frames its video shows the scene late: its frame i shows time i - lag.
    """
    found = {}
    for index, name in enumerate(rig.names):
        lag = (lag_frames or {}).get(name, 0.0)
        boxes, depth = exact_boxes(rig, index, flight, (np.arange(scene.frames) - lag) / FPS)
        frames, edges = _detected(boxes, depth, rig.cameras.image_size_wh[index], scene, rng)
        found[name] = Detections(frames, edges, np.ones(len(frames)))
    return found


def _detected(
    boxes: np.ndarray, depth: np.ndarray, size: np.ndarray, scene: Scene, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Frame numbers and edges of the boxes that a detector draws."""
    side = np.sqrt(np.maximum((boxes[..., 2:] - boxes[..., :2]).prod(axis=-1), 0.0))
    std = scene.noise_px + scene.noise_share * side
    quick, slow = rng.standard_normal((2, *boxes.shape))
    keep = np.exp(-1 / FPS)
    for frame in range(1, len(slow)):
        slow[frame] = keep * slow[frame - 1] + np.sqrt(1 - keep**2) * slow[frame]
    noise = np.sqrt(1 - scene.lasting) * quick + np.sqrt(scene.lasting) * slow
    # Edges are at half pixels: the first pixel's centre is at 0 in a projection, and at 0.5 in a box.
    boxes = boxes + 0.5 + std[..., None] * noise
    there = np.isfinite(boxes).all(axis=-1) & (depth > 0.5)
    frames, edges = [], []
    for frame in range(len(boxes)):
        seen = _merged(boxes[frame, there[frame]])
        seen = np.clip(seen, 0.0, np.tile(size, 2))
        seen = seen[((seen[:, 2:] - seen[:, :2]) > 3).all(axis=-1) & (rng.random(len(seen)) >= scene.missed)]
        alarms = rng.poisson(scene.false_alarms)
        corner = rng.random((alarms, 2)) * (size - 80)
        seen = np.concatenate([seen, np.hstack([corner, corner + rng.uniform(10, 70, (alarms, 2))])])
        frames.append(np.full(len(seen), frame))
        edges.append(seen[rng.permutation(len(seen))])
    return np.concatenate(frames), np.concatenate(edges)


def _merged(boxes: np.ndarray) -> np.ndarray:
    """Boxes that overlap become one."""
    boxes = list(boxes)
    again = True
    while again:
        again = False
        for first in range(len(boxes)):
            for second in range(first + 1, len(boxes)):
                a, b = boxes[first], boxes[second]
                shared = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
                smaller = min((a[2:] - a[:2]).prod(), (b[2:] - b[:2]).prod())
                if (shared > 0).all() and shared.prod() > 0.3 * smaller:
                    boxes[first] = np.concatenate([np.minimum(a[:2], b[:2]), np.maximum(a[2:], b[2:])])
                    del boxes[second]
                    again = True
                    break
            if again:
                break
    return np.array(boxes).reshape(-1, 4)


def turned(rig: Rig, index: int, degrees: float, rng: np.random.Generator) -> Rig:
    """The rig with one camera turned about its centre, about a random axis."""
    axis = rng.normal(size=3)
    R = Rotation.from_rotvec(degrees * axis / np.linalg.norm(axis), degrees=True).as_matrix()
    T = rig.cameras.T_cam_world.copy()
    T[index, :3] = R @ T[index, :3]
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def moved(rig: Rig, index: int, distance_m: float, rng: np.random.Generator) -> Rig:
    """The rig with one camera moved in a random direction."""
    shift = rng.normal(size=3)
    T = rig.cameras.T_cam_world.copy()
    T[index, :3, 3] += distance_m * shift / np.linalg.norm(shift)
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def refocused(rig: Rig, index: int, factor: float) -> Rig:
    """The rig with another focal length of one camera."""
    K = rig.cameras.K.copy()
    K[index, :2, :2] *= factor
    return Rig(rig.names, replace(rig.cameras, K=K))


def shift_px(true: Rig, given: Rig, flight: Flight, scene: Scene, index: int, lag: float = 0.0) -> float:
    """Median distance by which a fault moves the middles of one camera's boxes, pixels."""
    time_s = np.arange(scene.frames) / FPS
    before, _ = exact_boxes(true, index, flight, time_s)
    after, _ = exact_boxes(given, index, flight, time_s - lag / FPS)
    middle, then = ((boxes[..., :2] + boxes[..., 2:]) / 2 for boxes in (before, after))
    size = true.cameras.image_size_wh[index]
    inside = ((middle > 0) & (middle < size)).all(axis=-1)
    off = np.linalg.norm(then - middle, axis=-1)[inside]
    return float(np.median(off)) if len(off) else 0.0

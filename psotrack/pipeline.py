"""From a sequence to trajectories: silhouettes, a start, the tracker over chunks of frames, and a record of the run.

`track_sequence` is what the command line, sweeps and notebooks call.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Float

from psotrack import tracker
from psotrack.cameras import Camera, CameraRig
from psotrack.errors import InputError
from psotrack.fitness import PAPER_SCORE, ScoreSettings
from psotrack.initialisation import Start, find_drones
from psotrack.progress import Report, silent
from psotrack.sequence import Sequence
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes, compute
from psotrack.trajectories import Trajectories
from psotrack.trajectory_files import read_trajectories

#: Frames that are on the device at once. Eight 1080p cameras at a quarter of the size are 26 MB.
CHUNK_FRAMES = 25

#: Frames from which the drones are found. Longer, and their paths are no straight lines any more.
START_FRAMES = 10


@dataclass(frozen=True)
class TrackedSequence:
    """What tracking yields.

    Attributes:
        trajectories: every drone in every frame.
        start: where the drones were taken to be at frame 0, and their sizes.
        record: settings, versions, device, input keys and seconds per stage, fit for JSON.
    """

    trajectories: Trajectories
    start: Start
    record: Mapping[str, Any]


def track_sequence(
    sequence: Sequence,
    settings: TrackSettings = TrackSettings(),  # noqa: B008  frozen
    *,
    cache: Path,
    jobs: int | None = None,
    report: Report = silent,
) -> TrackedSequence:
    """Track the drones of a sequence from its videos.

    Args:
        sequence: fit for use (see `Sequence.usable`).
        settings: how.
        cache: folder of the stored silhouettes.
        jobs: processes for the silhouettes; None is one per processor.
        report: told of the frames of each stage.

    Raises:
        InputError: a video cannot be used, or the drones cannot be found.
        SettingsError: a setting does not fit the sequence.
        OutputError: the silhouettes cannot be stored.
    """
    began = time.perf_counter()
    silhouettes = compute(sequence, settings.silhouettes, cache=cache, jobs=jobs, report=report)
    tracking_began = time.perf_counter()
    bounds_m = room_bounds(sequence.rig, settings)
    start = find_start(sequence, silhouettes, settings, bounds_m)
    trajectories, compile_s = track_silhouettes(
        sequence.rig, silhouettes, start, settings, fps=sequence.fps, bounds_m=bounds_m, report=report
    )
    ended = time.perf_counter()
    seconds = {
        **silhouettes.seconds,
        "track": ended - tracking_began - compile_s,
        "compile": compile_s,
        "total": ended - began,
    }
    record = {
        "sequence": sequence.name,
        "frames": trajectories.num_frames,
        "cameras": list(silhouettes.cameras),
        "settings": msgspec.to_builtins(settings),
        "seed": settings.seed,
        "start": {name: value.tolist() for name, value in vars(start).items()},
        "bounds_m": bounds_m.tolist(),
        "input_keys": dict(silhouettes.keys),
        "seconds": {stage: round(value, 4) for stage, value in seconds.items()},
        **environment(),
    }
    return TrackedSequence(trajectories, start, record)


def track_silhouettes(
    rig: CameraRig,
    silhouettes: Silhouettes,
    start: Start,
    settings: TrackSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    report: Report = silent,
) -> tuple[Trajectories, float]:
    """Track from a known start; returns the trajectories and the seconds that compiling took."""
    program, params = tracker_inputs(silhouettes.reduction, start, settings, fps=fps, bounds_m=bounds_m)
    cameras = on_device(rig.cameras)
    position, velocity = (jnp.asarray(value, jnp.float32) for value in (start.position_m, start.velocity_m_s))
    state = tracker.init(jax.random.key(settings.seed), position, velocity, params)

    # Without iterations a chunk takes no time but the compiler's, which is how compiling is told from tracking.
    compile_began = time.perf_counter()
    idle = replace(params, num_iterations=jnp.int32(0))
    blank = np.zeros((CHUNK_FRAMES, len(rig), *silhouettes.shape), np.uint8)
    jax.block_until_ready(tracker.track(state, blank, cameras, idle, program))
    compile_s = time.perf_counter() - compile_began

    infos: list[tracker.TrackerInfo] = []
    with report("track", silhouettes.num_frames) as advance:
        for chunk, frames in _chunks(silhouettes):
            state, info = tracker.track(state, chunk, cameras, params, program)
            # The device works on this chunk while the next is read; only the one before must be done.
            if infos:
                jax.block_until_ready(infos[-1])
                advance(CHUNK_FRAMES)
            infos.append(jax.tree.map(lambda value, frames=frames: value[:frames], info))
        whole = jax.tree.map(lambda *parts: np.concatenate(parts), *infos)
        advance(frames)
    return _as_trajectories(whole, fps), compile_s


def tracker_inputs(
    reduction: int, start: Start, settings: TrackSettings, *, fps: float, bounds_m: Float[np.ndarray, "2 3"]
) -> tuple[tracker.Program, tracker.TrackerParams]:
    """What the tracker compiles, and the numbers that it is called with, from what people set."""
    score = ScoreSettings() if settings.score == "soft" else PAPER_SCORE
    program = tracker.Program(
        num_particles=settings.particles,
        joint=settings.swarm == "joint",
        claims=settings.score == "soft",
        score=replace(score, reduction=reduction),
    )
    params = tracker.TrackerParams(
        num_iterations=jnp.int32(settings.iterations),
        size_m=jnp.asarray(start.size_m, jnp.float32),
        bounds_m=jnp.asarray(bounds_m, jnp.float32),
        dt_s=jnp.float32(1 / fps),
        max_speed_m_s=jnp.float32(settings.max_speed_m_s),
        spread_m=jnp.float32(settings.spread_m),
        inertia=jnp.float32(settings.inertia),
        cognitive=jnp.float32(settings.cognitive),
        social=jnp.float32(settings.social),
        position_gain=jnp.float32(settings.position_gain),
        velocity_gain=jnp.float32(settings.velocity_gain),
        min_fitness=jnp.float32(settings.min_fitness),
        min_cameras=jnp.int32(settings.min_cameras),
        max_coasting_frames=jnp.int32(round(settings.max_coasting_s * fps)),
    )
    return program, params


def on_device(cameras: Camera) -> Camera:
    """The cameras in float32: what the tracker computes in."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cameras)


def room_bounds(rig: CameraRig, settings: TrackSettings) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of the room, metres.

    Where nobody says, the room is what the cameras stand around, a metre wider, from the floor at z = 0 (or below the
    lowest camera, if that is lower) to a metre above the highest one.
    """
    if settings.bounds_m is not None:
        return np.array(settings.bounds_m, np.float64).reshape(3, 2).T
    centre = rig.cameras.centre_world
    low, high = centre.min(axis=0) - 1.0, centre.max(axis=0) + 1.0
    low[2] = 0.0 if centre[:, 2].min() > 0 else low[2]
    return np.stack([low, high])


def find_start(
    sequence: Sequence, silhouettes: Silhouettes, settings: TrackSettings, bounds_m: Float[np.ndarray, "2 3"]
) -> Start:
    """Positions, velocities and sizes of the drones at frame 0, as `settings.init` says.

    Raises:
        InputError: there is no reference or file to start from, or too few drones are found.
    """
    found = find_drones(
        sequence.rig.cameras,
        silhouettes.read(0, min(START_FRAMES, silhouettes.num_frames)),
        reduction=silhouettes.reduction,
        fps=sequence.fps,
        bounds_m=bounds_m,
        max_speed_m_s=settings.max_speed_m_s,
    )
    if settings.init == "auto":
        start, source = found, sequence.folder
    else:
        known, source = _known_start(sequence, settings.init)
        start = _with_sizes(known, found, sequence.fps)
    wanted = settings.drones or max(len(start.position_m), 1)
    if len(start.position_m) < wanted:
        raise InputError(
            source,
            expected=f"{wanted} drone{'s' * (wanted > 1)} at frame 0 (--init {settings.init})",
            found=f"{len(start.position_m)}",
            remedy="say where they are with --init FILE, or how many with --drones",
        )
    start = Start(*(value[:wanted] for value in vars(start).values()))
    if settings.drone_size_m is not None:
        start = Start(
            start.position_m,
            start.velocity_m_s,
            np.broadcast_to(np.array(settings.drone_size_m), (wanted, 3)),
            start.num_cameras,
        )
    if not np.isfinite(start.size_m).all():
        raise InputError(
            source,
            expected="a size for every drone",
            found="drones that no camera sees by themselves",
            remedy="pass --drone-size X,Y,Z",
        )
    return start


def environment() -> dict[str, Any]:
    """Versions and device: what else a result depends on."""
    packages = ("psotrack", "jax", "jaxlib", "numpy", "opencv-python-headless", "zarr")
    device = jax.devices()[0]
    return {
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
        "device": {"platform": device.platform, "kind": device.device_kind, "machine": platform.machine()},
    }


def _chunks(silhouettes: Silhouettes) -> Iterator[tuple[np.ndarray, int]]:
    """Chunks of equal length, the last one filled up with empty frames, and the number of frames that count."""
    for first in range(0, silhouettes.num_frames, CHUNK_FRAMES):
        chunk = silhouettes.read(first, min(first + CHUNK_FRAMES, silhouettes.num_frames))
        frames = len(chunk)
        if frames < CHUNK_FRAMES:
            chunk = np.concatenate([chunk, np.zeros((CHUNK_FRAMES - frames, *chunk.shape[1:]), np.uint8)])
        yield chunk, frames


def _as_trajectories(info: tracker.TrackerInfo, fps: float) -> Trajectories:
    num_frames, num_drones = info.fitness.shape
    frame = np.arange(num_frames)
    return Trajectories(
        frame=frame,
        time_s=frame / fps,
        drones=tuple(str(drone) for drone in range(num_drones)),
        position_m=np.asarray(info.position_m, np.float64),
        velocity_m_s=np.asarray(info.velocity_m_s, np.float64),
        fitness=np.asarray(info.fitness, np.float64),
        num_cameras=np.asarray(info.num_cameras, np.int64),
        status=np.asarray(info.status, np.int64),
    )


def _known_start(sequence: Sequence, init: str) -> tuple[Trajectories, Path]:
    """The trajectories that a start is taken from, and where they come from."""
    if init != "truth":
        path = Path(init)
        return read_trajectories(path, fps=sequence.fps), path
    if sequence.truth is None:
        raise InputError(
            sequence.folder, expected="a reference for --init truth", found="none", remedy="use --init auto"
        )
    return sequence.truth, sequence.folder


def _with_sizes(known: Trajectories, found: Start, fps: float) -> Start:
    """A start from known trajectories: moved to frame 0, with the sizes of the drones that are seen there."""
    there = np.isfinite(known.position_m).all(axis=-1)
    positions, velocities, sizes, cameras = [], [], [], []
    for drone in np.flatnonzero(there.any(axis=0)):
        rows = np.flatnonzero(there[:, drone])[:2]
        point = known.position_m[rows, drone]
        frames = known.frame[rows]
        if known.velocity_m_s is not None:
            velocity = known.velocity_m_s[rows[0], drone]
        elif len(rows) == 2:
            velocity = (point[1] - point[0]) * fps / (frames[1] - frames[0])
        else:
            velocity = np.zeros(3)
        position = point[0] - velocity * frames[0] / fps
        distance = np.linalg.norm(found.position_m - position, axis=-1)
        nearest = distance.argmin() if len(distance) and distance.min() < 0.5 else None
        positions.append(position)
        velocities.append(velocity)
        sizes.append(np.full(3, np.nan) if nearest is None else found.size_m[nearest])
        cameras.append(0.0 if nearest is None else found.num_cameras[nearest])
    size = np.array(sizes).reshape(-1, 3)
    # A drone that no camera sees by itself is taken to be like the others.
    usual = np.nanmedian(size, axis=0) if np.isfinite(size).any() else np.full(3, np.nan)
    return Start(
        position_m=np.array(positions).reshape(-1, 3),
        velocity_m_s=np.array(velocities).reshape(-1, 3),
        size_m=np.where(np.isfinite(size), size, usual),
        num_cameras=np.array(cameras),
    )

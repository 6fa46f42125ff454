"""Perturbations as in laboratories: fewer cameras, errors of the calibration, clocks that differ, and noise.

All random numbers depend on the perturbation's `draw`. Each kind of perturbation and each camera has its own random
stream, so its random numbers do not depend on other perturbations, on their size, or on the other cameras. So the cells
of a grid differ only in what the grid varies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig
from psotrack.recordings import Recording
from psotrack.sweeps.cells import Perturbation

#: Random stream of each kind of perturbation; these numbers decide the results.
_CAMERAS, _EXTRINSICS, _CLOCKS, _FLIPS = range(4)

#: Number of frames that are converted at once; it decides the results too.
_BLOCK_FRAMES = 50

_Frames = UInt8[np.ndarray, "frames height width"]


def perturb(
    recording: Recording,
    silhouettes: Silhouettes | None,
    perturbation: Perturbation,
    cameras: tuple[str, ...] | int | None,
) -> tuple[Recording, Silhouettes | None]:
    """Apply a perturbation to a sequence and its silhouettes, and select cameras.

    Args:
        recording: a usable recording with all its cameras.
        silhouettes: silhouettes of all cameras; None for a method that reads none. Changed silhouettes are in memory,
            under the same keys.
        perturbation: the perturbation.
        cameras: names of the cameras to keep; or their number, for a choice by `choose_cameras`; or None for all.

    Raises:
        SettingsError: a camera does not exist, or there are fewer cameras than asked for.
    """
    every = recording.rig.names
    if isinstance(cameras, int):
        kept = choose_cameras(every, cameras, perturbation.draw)
    else:
        kept = recording.rig.select(cameras).names if cameras else every
    if kept != every:
        # The recording is usable as it is: not every method needs videos.
        recording = recording.usable(list(kept), videos=False)
        silhouettes = None if silhouettes is None else _of_cameras(silhouettes, kept)
    # Random streams depend on the camera's index in the whole rig.
    index = [every.index(name) for name in kept]
    if perturbation.extrinsics_deg:
        rngs = [_rng(_EXTRINSICS, perturbation.draw, camera) for camera in index]
        recording = recording.with_rig(_turn_cameras(recording.rig, perturbation.extrinsics_deg, rngs))
    if silhouettes is not None and perturbation.clock_frames:
        arrays = [
            _delay(stored, late)
            for stored, late in zip(
                _frames_by_camera(silhouettes), delays_frames(perturbation, index), strict=True
            )
        ]
        silhouettes = replace(silhouettes, arrays=tuple(arrays))
    if silhouettes is not None and perturbation.flipped:
        rngs = [_rng(_FLIPS, perturbation.draw, camera) for camera in index]
        arrays = [
            _flip_pixels(stored, perturbation.flipped, silhouettes.reduction**2, rng)
            for stored, rng in zip(_frames_by_camera(silhouettes), rngs, strict=True)
        ]
        silhouettes = replace(silhouettes, arrays=tuple(arrays))
    return recording, silhouettes


def delays_frames(perturbation: Perturbation, cameras: Iterable[int]) -> list[float]:
    """By how many frames the videos of some cameras show the scene late.

    Args:
        perturbation: the perturbation.
        cameras: indices of the cameras in the whole rig.
    """
    return [
        float(_rng(_CLOCKS, perturbation.draw, camera).uniform(0, perturbation.clock_frames))
        for camera in cameras
    ]


def choose_cameras(names: tuple[str, ...], count: int, draw: int) -> tuple[str, ...]:
    """Choose cameras: a different subset for each draw, until all subsets have been chosen.

    Args:
        names: names of all cameras.
        count: number of cameras to choose.
        draw: number of the draw, from 0.

    Returns:
        The chosen names, in the order of `names`.

    Raises:
        SettingsError: `count` is not between 1 and the number of cameras.
    """
    if not 0 < count <= len(names):
        expected = f"1 to {len(names)}, the number of cameras"
        raise SettingsError("cameras", expected=expected, found=f"{count}")
    rng = _rng(_CAMERAS)
    drawn: dict[tuple[int, ...], None] = {}
    while len(drawn) <= draw % math.comb(len(names), count):
        drawn[tuple(sorted(rng.permutation(len(names))[:count].tolist()))] = None
    return tuple(names[camera] for camera in list(drawn)[-1])


def _rng(kind: int, draw: int = 0, camera: int = 0) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(draw, spawn_key=(kind, camera)))


def _of_cameras(silhouettes: Silhouettes, names: tuple[str, ...]) -> Silhouettes:
    """Silhouettes of some cameras only."""
    return replace(
        silhouettes,
        cameras=names,
        keys={name: silhouettes.keys[name] for name in names if name in silhouettes.keys},
        left_out={name: silhouettes.left_out[name] for name in names if name in silhouettes.left_out},
        arrays=tuple(silhouettes.arrays[silhouettes.cameras.index(name)] for name in names),
    )


def _frames_by_camera(silhouettes: Silhouettes) -> Iterator[_Frames]:
    """Yield all frames of each camera, one camera at a time."""
    for name in silhouettes.cameras:
        yield _of_cameras(silhouettes, (name,)).read(0, silhouettes.num_frames)[:, 0]


def _turn_cameras(rig: Rig, angle_deg: float, rngs: list[np.random.Generator]) -> Rig:
    """Turn each camera about its centre, around a random axis with uniformly distributed direction."""
    T_cam_world = rig.cameras.T_cam_world.copy()
    for camera, rng in enumerate(rngs):
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
        # R and t are both turned, so that the centre -R^T t does not change.
        T_cam_world[camera, :3] = turn @ T_cam_world[camera, :3]
    return replace(rig, cameras=replace(rig.cameras, T_cam_world=T_cam_world))


def _delay(stored: _Frames, frames: float) -> _Frames:
    """Delay a camera: frame f becomes frame f - `frames`, interpolated between the two nearest frames.

    Frames before the first one are equal to the first frame.
    """
    whole = math.floor(frames)
    fraction = np.float32(frames - whole)
    late = np.empty_like(stored)
    for block in _blocks(len(stored)):
        index = np.arange(block.start, block.stop) - whole
        nearer, farther = (stored[np.maximum(at, 0)].astype(np.float32) for at in (index, index - 1))
        late[block] = np.round((1 - fraction) * nearer + fraction * farther)
    return late


def _flip_pixels(stored: _Frames, fraction: float, pixels: int, rng: np.random.Generator) -> _Frames:
    """Flip a random fraction of the full-size pixels; each value of the silhouettes stands for `pixels` pixels."""
    noisy = np.empty_like(stored)
    for block in _blocks(len(stored)):
        count = np.round(stored[block] / 255 * pixels).astype(np.int64)
        count = count - rng.binomial(count, fraction) + rng.binomial(pixels - count, fraction)
        noisy[block] = np.round(255 * count / pixels)
    return noisy


def _blocks(num_frames: int) -> Iterator[slice]:
    for start in range(0, num_frames, _BLOCK_FRAMES):
        yield slice(start, min(start + _BLOCK_FRAMES, num_frames))

"""What laboratories have: fewer cameras, calibration that is a little off, clocks that differ, noise.

Everything is drawn by the perturbation's `draw`, and for each kind and camera from a stream of its own: what is drawn
for one does not depend on what else is done, on how much, or on which other cameras there are. So the cells of a
grid differ in nothing but what the grid varies.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.geometry import Rig
from psotrack.recordings import Sequence
from psotrack.silhouettes import Silhouettes
from psotrack.sweep.cells import Perturbation

#: Each kind's stream; the numbers are part of the results.
_CAMERAS, _EXTRINSICS, _CLOCKS, _FLIPS = range(4)

#: Frames in memory at once, as wider numbers; part of the results too.
_BLOCK_FRAMES = 50

_Frames = UInt8[np.ndarray, "frames height width"]


def perturbed(
    sequence: Sequence,
    silhouettes: Silhouettes | None,
    perturbation: Perturbation,
    cameras: tuple[str, ...] | int | None,
) -> tuple[Sequence, Silhouettes | None]:
    """The input of a cell.

    Args:
        sequence: fit for use, with all of its cameras.
        silhouettes: of all of its cameras; what is changed of them is in memory then, under the same keys. None where
            nothing is read of them.
        perturbation: what is done.
        cameras: the names of those to keep; how many of them, chosen by the draw (see `chosen`); or None for all.

    Raises:
        SettingsError: there are no such cameras, or not so many.
    """
    every = sequence.rig.names
    if isinstance(cameras, int):
        kept = chosen(every, cameras, perturbation.draw)
    else:
        kept = sequence.rig.select(cameras).names if cameras else every
    if kept != every:
        sequence = sequence.usable(list(kept))
        silhouettes = None if silhouettes is None else _of_cameras(silhouettes, kept)
    # A camera's number is that of the whole rig.
    index = [every.index(name) for name in kept]
    if perturbation.extrinsics_deg:
        rngs = [_rng(_EXTRINSICS, perturbation.draw, camera) for camera in index]
        sequence = replace(sequence, rig=_turned(sequence.rig, perturbation.extrinsics_deg, rngs))
    if silhouettes is not None and perturbation.clock_frames:
        rngs = [_rng(_CLOCKS, perturbation.draw, camera) for camera in index]
        late_frames = [rng.uniform(0, perturbation.clock_frames) for rng in rngs]
        arrays = [
            _late(stored, late) for stored, late in zip(_of_each(silhouettes), late_frames, strict=True)
        ]
        silhouettes = replace(silhouettes, arrays=tuple(arrays))
    if silhouettes is not None and perturbation.flipped:
        rngs = [_rng(_FLIPS, perturbation.draw, camera) for camera in index]
        arrays = [
            _flipped(stored, perturbation.flipped, silhouettes.reduction**2, rng)
            for stored, rng in zip(_of_each(silhouettes), rngs, strict=True)
        ]
        silhouettes = replace(silhouettes, arrays=tuple(arrays))
    return sequence, silhouettes


def chosen(names: tuple[str, ...], count: int, draw: int) -> tuple[str, ...]:
    """So many of the names, in their order: another subset for each draw, until there is no other.

    Args:
        names: to choose from.
        count: how many.
        draw: 0, 1, ...; as many as there are subsets yield each of them once.

    Raises:
        SettingsError: there are not so many.
    """
    if not 0 < count <= len(names):
        expected = f"1 to {len(names)}, as many as there are"
        raise SettingsError("cameras", expected=expected, found=f"{count}")
    rng = _rng(_CAMERAS)
    drawn: dict[tuple[int, ...], None] = {}
    while len(drawn) <= draw % math.comb(len(names), count):
        drawn[tuple(sorted(rng.permutation(len(names))[:count].tolist()))] = None
    return tuple(names[camera] for camera in list(drawn)[-1])


def _rng(kind: int, draw: int = 0, camera: int = 0) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(draw, spawn_key=(kind, camera)))


def _of_cameras(silhouettes: Silhouettes, names: tuple[str, ...]) -> Silhouettes:
    """The silhouettes as if there were no other cameras."""
    return replace(
        silhouettes,
        cameras=names,
        keys={name: silhouettes.keys[name] for name in names},
        arrays=tuple(silhouettes.arrays[silhouettes.cameras.index(name)] for name in names),
    )


def _of_each(silhouettes: Silhouettes) -> Iterator[_Frames]:
    """All frames of one camera after the other."""
    for name in silhouettes.cameras:
        yield _of_cameras(silhouettes, (name,)).read(0, silhouettes.num_frames)[:, 0]


def _turned(rig: Rig, angle_deg: float, rngs: list[np.random.Generator]) -> Rig:
    """Cameras turned about their own centres, each about an axis of its own, all directions equally likely."""
    T_cam_world = rig.cameras.T_cam_world.copy()
    for camera, rng in enumerate(rngs):
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
        # R and t alike, so that the centre, -R^T t, stays.
        T_cam_world[camera, :3] = turn @ T_cam_world[camera, :3]
    return replace(rig, cameras=replace(rig.cameras, T_cam_world=T_cam_world))


def _late(stored: _Frames, frames: float) -> _Frames:
    """A camera that is late: at frame f it shows what was at f - `frames`, mixed of the two nearest.

    Before its first frame it shows its first.
    """
    whole = math.floor(frames)
    share = np.float32(frames - whole)
    late = np.empty_like(stored)
    for block in _blocks(len(stored)):
        index = np.arange(block.start, block.stop) - whole
        nearer, farther = (stored[np.maximum(at, 0)].astype(np.float32) for at in (index, index - 1))
        late[block] = np.round((1 - share) * nearer + share * farther)
    return late


def _flipped(stored: _Frames, share: float, pixels: int, rng: np.random.Generator) -> _Frames:
    """Silhouettes with full-size pixels the other way round, `pixels` of them in each of the values."""
    noisy = np.empty_like(stored)
    for block in _blocks(len(stored)):
        count = np.round(stored[block] / 255 * pixels).astype(np.int64)
        count = count - rng.binomial(count, share) + rng.binomial(pixels - count, share)
        noisy[block] = np.round(255 * count / pixels)
    return noisy


def _blocks(num_frames: int) -> Iterator[slice]:
    for start in range(0, num_frames, _BLOCK_FRAMES):
        yield slice(start, min(start + _BLOCK_FRAMES, num_frames))

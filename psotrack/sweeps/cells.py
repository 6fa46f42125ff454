"""Cells, the combinations of a grid, the key under which a cell's results are stored, and perturbations of its input.

A key is NAME-INPUT. NAME is a digest of the combination alone. INPUT is a digest of everything that the cell reads and
of the code that computes its rows, so that rows of another recording or of another tracker have another key.

Perturbations are those of laboratories: fewer cameras, errors of the calibration, clocks that differ, and noise. All
random numbers depend on the perturbation's `draw`. Each kind of perturbation and each camera has its own random stream,
so its random numbers do not depend on other perturbations, on their size, or on the other cameras. So the cells of a
grid differ only in what the grid varies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings, flatten
from psotrack.support import Share, check_types, digest_record

#: Number of hexadecimal digits of a digest in names.
_DIGITS = 20


class Perturbation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Errors that are added to a cell's input before tracking; 0 adds no error.

    Attributes:
        extrinsics_deg: angle by which every camera is turned about its own centre, around a random axis, degrees.
        clock_frames: largest delay of a camera, frames; each camera gets a random delay from 0 to this, with fractions.
        flipped: fraction of the full-size silhouettes' pixels that are inverted.
        draw: number of the random draw, from 0.

    Raises:
        SettingsError: a value is out of range.
    """

    extrinsics_deg: Annotated[float, msgspec.Meta(ge=0, le=180)] = 0.0
    clock_frames: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = 0.0
    flipped: Share = 0.0
    draw: Annotated[int, msgspec.Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        check_types(self)

    @property
    def is_random(self) -> bool:
        """Whether the perturbation uses random numbers."""
        return any((self.extrinsics_deg, self.clock_frames, self.flipped))


@dataclass(frozen=True)
class Cell:
    """One combination of a grid.

    Attributes:
        sequence: the sequence, as the grid names it: a folder, or a name under the data's root.
        method: name of the cell's table [methods.NAME]; "" if the grid has no such tables.
        cameras: names of the cameras; or their number, for a random choice by `perturbation.draw`; None for all.
        frames: number of frames, from the first on; None for all frames.
        perturbation: errors that are added to the input.
        settings: settings of every run; the seed is 0, and each run replaces it by its own.
        runs: number of runs.
        axes: values that the grid varies, by dotted name; cameras as text.
        first_seed: seed of the first run.
    """

    sequence: str
    method: str
    cameras: tuple[str, ...] | int | None
    frames: int | None
    perturbation: Perturbation
    settings: TrackSettings
    runs: int
    axes: Mapping[str, Any]
    first_seed: int = 0

    @property
    def seeds(self) -> range:
        """Seeds of the runs, in order."""
        return range(self.first_seed, self.first_seed + self.runs)

    @property
    def is_random(self) -> bool:
        """Whether the cell's input depends on random numbers."""
        return isinstance(self.cameras, int) or self.perturbation.is_random


def input_digest(keys: Mapping[str, str]) -> str:
    """One digest of the digests of everything on which a cell's rows depend besides its combination."""
    return digest_record(keys)[:_DIGITS]


def cell_name(cell: Cell) -> str:
    """Digest of a cell's combination: of everything that a grid says of the cell, except its seeds.

    `runs`, `first_seed` and `axes` are not part of it: rows of a cell are distinguished by their seeds, so more runs of
    a finished cell only add rows. The place of the sequence's folder is not part of it either. The method's name is,
    because rows have a column with this name.
    """
    return digest_record(
        {
            "sequence": Path(cell.sequence).name,
            "method": cell.method,
            "cameras": cell.cameras,
            "frames": cell.frames,
            "perturbation": cell.perturbation,
            "settings": msgspec.structs.replace(cell.settings, seed=0),
        }
    )[:_DIGITS]


def cell_key(cell: Cell, input_keys: Mapping[str, str]) -> str:
    """Key of a cell's results: a digest of everything except the seed that decides a row.

    Args:
        cell: the cell.
        input_keys: digests of everything that the cell reads, and of the code, by name (see `Inputs.keys_of`).
    """
    return f"{cell_name(cell)}-{input_digest(input_keys)}"


def cameras_label(cameras: tuple[str, ...] | int | None) -> str:
    """Text for a cell's cameras: `all`, their number such as `4`, or names such as `cam1+cam2`."""
    if cameras is None:
        return "all"
    return str(cameras) if isinstance(cameras, int) else "+".join(cameras)


def describe(cell: Cell) -> dict[str, Any]:
    """Description of a cell as a flat table, whose names have dots."""
    settings = msgspec.to_builtins(cell.settings)
    del settings["seed"]
    return {
        "sequence": Path(cell.sequence).name,
        "method": cell.method,
        "cameras": cameras_label(cell.cameras),
        "frames": cell.frames,
        **{f"perturbation.{name}": value for name, value in msgspec.to_builtins(cell.perturbation).items()},
        **{f"settings.{name}": value for name, value in flatten(settings)},
    }


def title(cell: Cell) -> str:
    """Description of a cell in one line."""
    axes = (f"{name}={value}" for name, value in cell.axes.items())
    return " ".join(word for word in (Path(cell.sequence).name, cell.method, *axes) if word)


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
        late = map(_delay, _frames_by_camera(silhouettes), delays_frames(perturbation, index))
        silhouettes = replace(silhouettes, arrays=tuple(late))
    if silhouettes is not None and perturbation.flipped:
        of_cameras, pixels = _frames_by_camera(silhouettes), silhouettes.reduction**2
        noisy = [
            _flip_pixels(stored, perturbation.flipped, pixels, _rng(_FLIPS, perturbation.draw, camera))
            for stored, camera in zip(of_cameras, index, strict=True)
        ]
        silhouettes = replace(silhouettes, arrays=tuple(noisy))
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

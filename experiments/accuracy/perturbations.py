"""How accuracy suffers from what laboratories have: fewer cameras, clocks that differ, poor calibration, noise.

    python experiments/accuracy/perturbations.py --data data

Tracks three flights of S02_D4_A (joint swarm, 100 x 70, drones found by themselves) without each of the cameras, from
four and three of them, with camera clocks that are off by up to a frame, with cameras turned by 0.2 degrees, and with
3 % of the full-size silhouettes' pixels flipped. Writes one row per run (CSV) and the machine's description (JSON);
prints means and the worst.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import _runs
import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.cameras import CameraRig
from psotrack.sequence import Sequence
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes

NAME = "S02_D4_A"
EFFORT = {"swarm": "joint", "particles": 100, "iterations": 70}
EXTRINSICS_DEG = 0.2
FLIPPED = 0.03


def with_arrays(silhouettes: Silhouettes, arrays: list[np.ndarray]) -> Silhouettes:
    """Silhouettes in memory instead of stored ones."""
    return replace(silhouettes, arrays=tuple(arrays))


def of_cameras(
    sequence: Sequence, silhouettes: Silhouettes, names: tuple[str, ...]
) -> tuple[Sequence, Silhouettes]:
    """The sequence as if there were no other cameras."""
    index = [silhouettes.cameras.index(name) for name in names]
    kept = replace(
        silhouettes,
        cameras=names,
        keys={name: silhouettes.keys[name] for name in names},
        arrays=tuple(silhouettes.arrays[camera] for camera in index),
    )
    return sequence.usable(list(names)), kept


def off_clocks(silhouettes: Silhouettes, rng: np.random.Generator) -> Silhouettes:
    """Cameras that are late by 0 to 1 frame: each frame is mixed of the two nearest."""
    arrays = []
    for array in silhouettes.arrays:
        frames = np.asarray(array[:], np.float32)
        late = rng.uniform()
        before = np.concatenate([frames[:1], frames[:-1]])
        arrays.append(np.round((1 - late) * frames + late * before).astype(np.uint8))
    return with_arrays(silhouettes, arrays)


def whole_frames_late(silhouettes: Silhouettes, rng: np.random.Generator) -> Silhouettes:
    """Cameras of which half, chosen by chance, are one frame late: the worst that a frame's offset can be."""
    late = rng.permutation(len(silhouettes.arrays)) < len(silhouettes.arrays) // 2
    arrays = [
        np.concatenate([array[:1], array[:-1]]) if is_late else array[:]
        for array, is_late in zip(silhouettes.arrays, late, strict=True)
    ]
    return with_arrays(silhouettes, arrays)


def turned(rig: CameraRig, rng: np.random.Generator) -> CameraRig:
    """Cameras turned about their own centres by `EXTRINSICS_DEG`, each about an axis of chance."""
    T = np.array(rig.cameras.T_cam_world)
    for camera in range(len(rig)):
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(EXTRINSICS_DEG) * axis / np.linalg.norm(axis)).as_matrix()
        T[camera, :3] = turn @ T[camera, :3]
    return replace(rig, cameras=replace(rig.cameras, T_cam_world=T))


def flipped(silhouettes: Silhouettes, rng: np.random.Generator) -> Silhouettes:
    """Silhouettes of which `FLIPPED` of the full-size pixels are the other way round, before they were reduced."""
    pixels = silhouettes.reduction**2
    arrays = []
    for array in silhouettes.arrays:
        count = np.round(array[:] / 255 * pixels).astype(np.int64)
        count = count - rng.binomial(count, FLIPPED) + rng.binomial(pixels - count, FLIPPED)
        arrays.append(np.round(255 * count / pixels).astype(np.uint8))
    return with_arrays(silhouettes, arrays)


def cases(
    sequence: Sequence, silhouettes: Silhouettes, subsets: int, seed: int
) -> Iterator[tuple[str, str, Sequence, Silhouettes]]:
    """What is done to a flight, in words and in detail, and what is tracked."""
    rng = np.random.default_rng(seed)
    yield "as it is", "", sequence, silhouettes
    for count in (7, 4, 3):
        every = list(combinations(silhouettes.cameras, count))
        chosen = every if len(every) <= subsets else [every[i] for i in rng.permutation(len(every))[:subsets]]
        label = "one camera missing" if count == 7 else f"{count} of 8 cameras"
        for subset in chosen:
            yield label, "+".join(subset), *of_cameras(sequence, silhouettes, subset)
    yield "half of the cameras one frame late", "", sequence, whole_frames_late(silhouettes, rng)
    yield "clocks 0 to 1 frame late", "", sequence, off_clocks(silhouettes, rng)
    rig = turned(sequence.rig, rng)
    yield f"cameras turned by {EXTRINSICS_DEG} degrees", "", replace(sequence, rig=rig), silhouettes
    yield f"{FLIPPED:.0%} of the pixels flipped", "", sequence, flipped(silhouettes, rng)


def run(seed: int, label: str, detail: str, sequence: Sequence, silhouettes: Silhouettes) -> dict[str, Any]:
    """One row."""
    settings = TrackSettings(seed=seed, **EFFORT)
    return {"case": label, "detail": detail, "seed": seed} | _runs.figures(sequence, silhouettes, settings)


def main() -> None:
    """Track, write, print."""
    parser = _runs.parser(__doc__)
    parser.add_argument(
        "--subsets", type=int, default=8, help="of each number of cameras, drawn by chance for each flight"
    )
    parser.add_argument(
        "--seeds", type=int, default=3, help="seeds of flight, perturbation and swarm: 0, 1, ..."
    )
    options = parser.parse_args()
    rows = (
        partial(run, seed, *case)
        for seed in range(options.seeds)
        for case in cases(*_runs.opened(NAME, options.data, seed), options.subsets, seed)
    )
    table = _runs.table(rows, options.out / "perturbations.csv")
    grouped = table.groupby("case", sort=False)[[*_runs.KEPT, "drones_found"]]
    print("mean", grouped.mean().T.to_string(float_format="{:.4f}".format), sep="\n")
    print("worst", grouped.max().T.to_string(float_format="{:.4f}".format), sep="\n")


if __name__ == "__main__":
    main()

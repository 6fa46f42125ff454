"""Peak resident memory of tracking a long sequence: 3,000 frames of 8 cameras, against a limit of 2 GB.

Draws silhouettes, stores them in psotrack's format, and tracks the stored silhouettes by psotrack's pipeline. The exit
code is 1 if the memory exceeds the limit. `python experiments/benchmarks/memory.py --help`.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

import _scene
import click
import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from psotrack.initiation import InitialState
from psotrack.settings import SwarmSettings, TrackSettings
from psotrack.silhouettes import Silhouettes, open_stored
from psotrack.silhouettes.store import CHUNK_FRAMES
from psotrack.support import progress_bar
from psotrack.tracking import RunInputs, track_silhouettes, tracker_settings

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results


@click.command(context_settings={"show_default": True})
@click.option("--frames", default=3000, type=click.IntRange(2), help="Frames that are tracked.")
@click.option("--cameras", default=8, type=click.IntRange(2), help="Cameras of 1920 x 1080 pixels.")
@click.option("--drones", default=4, type=click.IntRange(1), help="Drones in the room.")
@click.option(
    "--particles",
    default=TrackSettings().swarm.particles,
    type=click.IntRange(2),
    help="Particles of every swarm.",
)
@click.option(
    "--iterations",
    default=TrackSettings().swarm.iterations,
    type=click.IntRange(0),
    help="Iterations per frame.",
)
@click.option("--limit-gb", default=2.0, help="Largest resident memory, 10^9 bytes.")
@click.option(
    "--results", type=click.Path(path_type=Path), help="Write the result and its record into this folder."
)
def main(
    frames: int,
    cameras: int,
    drones: int,
    particles: int,
    iterations: int,
    limit_gb: float,
    results: Path | None,
) -> None:
    """Track a long sequence from stored silhouettes; print the peak of the resident memory."""
    run = _results.Run("memory")
    scene = _scene.scene(frames, drones, cameras)
    start = InitialState(
        scene.position_m[0], scene.velocity_m_s[0], scene.size_m, np.full(drones, float(cameras))
    )
    with tempfile.TemporaryDirectory() as folder:
        silhouettes = _store(scene, Path(folder))
        before_gb = _peak_gb()
        began = time.perf_counter()
        ((tracks, compile_s),) = track_silhouettes(
            scene.rig,
            silhouettes,
            [
                RunInputs(
                    start,
                    _scene.BOUNDS_M,
                    tracker_settings(
                        TrackSettings(swarm=SwarmSettings(particles=particles, iterations=iterations))
                    ),
                )
            ],
            fps=_scene.FPS,
            report=progress_bar,
        )
        track_s = time.perf_counter() - began - compile_s
    peak_gb = _peak_gb()

    errors_m = np.linalg.norm(tracks.position_m - scene.position_m, axis=-1)
    print(
        f"{frames} frames of {cameras} cameras, {drones} drones, {particles} particles x {iterations} iterations"
    )
    print(
        f"tracked in {track_s:.1f} s ({1e3 * track_s / frames:.1f} ms per frame), {compile_s:.1f} s to compile"
    )
    print(f"mean error {1e3 * errors_m.mean():.1f} mm")
    print(
        f"peak resident memory {peak_gb:.2f} GB (before tracking {before_gb:.2f} GB), limit {limit_gb:g} GB"
    )
    if results is not None:
        shape = {"frames": frames, "cameras": cameras, "drones": drones}
        figures = {
            **shape,
            "particles": particles,
            "iterations": iterations,
            "track_s": track_s,
            "track_ms_per_frame": 1e3 * track_s / frames,
            "compile_s": compile_s,
            "mean_error_m": float(errors_m.mean()),
            "peak_gb": peak_gb,
            "before_gb": before_gb,
            "limit_gb": limit_gb,
        }
        run.save(results, figures=figures)
    sys.exit(peak_gb > limit_gb)


def _store(scene: _scene.Scene, folder: Path) -> Silhouettes:
    """Store the silhouettes of a scene; paths are closed, so one period is drawn and written repeatedly."""
    num_frames, names = len(scene.position_m), scene.rig.names
    arrays = [
        zarr.create_array(
            folder / name,
            shape=(num_frames, *scene.shape),
            chunks=(CHUNK_FRAMES, *scene.shape),
            dtype=np.uint8,
            compressors=ZstdCodec(level=3, checksum=True),
            config={"write_empty_chunks": True},
        )
        for name in names
    ]
    for first in range(0, min(_scene.PERIOD_FRAMES, num_frames), CHUNK_FRAMES):
        drawn = scene.coverage(slice(first, first + CHUNK_FRAMES))
        for frame in range(first, num_frames, _scene.PERIOD_FRAMES):
            for index, array in enumerate(arrays):
                count = min(len(drawn), num_frames - frame)
                array[frame : frame + count] = drawn[:count, index]
    stored = tuple(open_stored(folder / name, num_frames, scene.shape) for name in names)
    assert None not in stored, "a chunk was not written"
    return Silhouettes(
        cameras=names,
        keys={name: name for name in names},
        reduction=_scene.REDUCTION,
        num_frames=num_frames,
        shape=scene.shape,
        seconds={"decode": 0.0, "foreground": 0.0},
        arrays=stored,
    )


def _peak_gb() -> float:
    """Largest resident memory of this process so far, 10^9 bytes."""
    # The unit is KiB on Linux and bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


if __name__ == "__main__":
    main()

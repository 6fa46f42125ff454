"""The tracker of an earlier commit, in a process of its own, so that both versions are timed in turn.

The process uses the package and the benchmark of the commit; the scene has been the same since the first benchmark. It
reads a kind of swarm per line, tracks once, and writes the times and the positions' mean error as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Times:
    """Times of one call per frame, milliseconds, and the mean error of its positions, millimetres."""

    wall_ms: float
    cpu_ms: float
    error_mm: float


class Baseline:
    """Tracks with the package of a commit."""

    def __init__(self, commit: str, shapes: dict[str, int]) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._process: subprocess.Popen[str] | None = None
        archive = Path(self._folder.name) / "package.tar"
        made = subprocess.run(
            ["git", "archive", "-o", str(archive), commit, "psotrack", "experiments"],
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        if made.returncode:
            raise click.ClickException(f"--baseline {commit}: {made.stderr.strip()}")
        with tarfile.open(archive) as files:
            files.extractall(self._folder.name, filter="data")
        folder = Path(self._folder.name)
        paths = [str(folder), str(folder / "experiments/benchmarks"), os.environ.get("PYTHONPATH", "")]
        # Without -P, Python would find today's benchmark first.
        self._process = subprocess.Popen(
            [sys.executable, "-P", __file__, json.dumps(shapes)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        )

    def timed(self, kind: str) -> Times:
        """Track once with a kind of swarm."""
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(kind, file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        if not answer:
            raise click.ClickException("the process of the baseline has ended")
        return Times(**json.loads(answer))

    def close(self) -> None:
        """End the process and remove its package."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            self._process.wait()
        self._folder.cleanup()


def _serve(shapes: dict[str, int]) -> None:
    import _scene
    import numpy as np
    import track_stage

    scene = _scene.scene(shapes["frames"], shapes["drones"], shapes["cameras"])
    coverage = scene.coverage()
    methods: dict[str, Any] = {}
    for line in sys.stdin:
        kind = line.strip()
        if kind not in methods:
            methods[kind] = track_stage.Psotrack(_problem(scene, shapes, kind))
        began, cpu_began = time.perf_counter(), time.process_time()
        found_m = methods[kind](coverage)
        wall_s, cpu_s = time.perf_counter() - began, time.process_time() - cpu_began
        error_mm = 1e3 * float(np.linalg.norm(found_m - scene.position_m, axis=-1).mean())
        times = {"wall_ms": 1e3 * wall_s / len(coverage), "cpu_ms": 1e3 * cpu_s / len(coverage)}
        print(json.dumps({**times, "error_mm": error_mm}), flush=True)


def _problem(scene: Any, shapes: dict[str, int], kind: str) -> Any:
    """The scene for a kind of swarm, as the benchmark of the commit states it."""
    import track_stage

    from psotrack import settings

    swarm = {"particles": shapes["particles"], "iterations": shapes["iterations"]}
    if hasattr(track_stage, "make_problem"):
        return track_stage.make_problem(scene, *swarm.values(), kind)
    # The first versions had flat settings.
    if "particles" in settings.TrackSettings.__struct_fields__:
        return track_stage._problem(scene, settings.TrackSettings(**swarm, swarm=kind))
    of_swarm = settings.SwarmSettings(**swarm, kind=kind)
    return track_stage._problem(scene, settings.TrackSettings(swarm=of_swarm))


if __name__ == "__main__":
    _serve(json.loads(sys.argv[1]))

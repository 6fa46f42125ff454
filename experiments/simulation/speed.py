"""Time of the simulator: processor milliseconds per frame of one camera, stage by stage.

    python experiments/simulation/speed.py --scenario S02_D4_A --frames 60

The script uses one thread. Cameras and segments are drawn in parallel by `psotrack simulate`, so one second of video
(25 frames) of eight cameras takes about 200 times the total, divided by the cores.
"""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from psotrack.recordings import VideoWriter
from psotrack.recordings.datasets import MaskWriter
from psotrack.simulation import CameraRenderer, Scene, build, preset_names, scenario
from psotrack.simulation.imaging.onboard import OnboardRenderer
from psotrack.simulation.labels.detector import detect
from psotrack.simulation.labels.masks import silhouettes

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

_spent_s: dict[str, float] = defaultdict(float)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Add the processor time of the block to a stage."""
    began = time.process_time()
    yield
    _spent_s[name] += time.process_time() - began


def static_camera(scene: Scene, frames: range, folder: Path) -> None:
    """Make the video, detections and masks of one static camera."""
    with stage("set-up"):
        renderer = CameraRenderer(scene, 0)
    size_wh = renderer.cam.width, renderer.cam.height
    black = np.zeros(size_wh[::-1], bool)
    with VideoWriter(folder / "static.avi", 25.0, size_wh) as video, MaskWriter(folder / "m.zip") as masks:
        for frame in frames:
            with stage("drones, shadows, reflections"):
                clean = renderer.clean_frame(frame)
            with stage("sensor"):
                image = renderer.sensor.expose(clean, frame, scene.time_s(frame))
            with stage("codec"):
                video.write(image)
            with stage("detections"):
                drones = silhouettes(scene, renderer.cam, renderer.backdrop.depth_m, frame)
                detect(scene, 0, frame, drones)
            with stage("masks"):
                there = {one.number: one.mask() for one in drones}
                for number in range(1, len(scene.flights) + 1):
                    masks.write("cam1i", number, frame, there.get(number, black))


def onboard_camera(scene: Scene, frames: range, folder: Path) -> None:
    """Make the video of the first drone's own camera."""
    renderer = OnboardRenderer(scene, 0)
    with VideoWriter(folder / "onboard.avi", 25.0, (renderer.width, renderer.height)) as video:
        for frame in frames:
            with stage("on-board video"):
                video.write(renderer.frame(frame))


def main() -> None:
    """Time the scenarios, and print and save the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", choices=preset_names(), action="append", help="[default: S02_D4_A]")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--results", type=Path, help="write the result and its record into this folder")
    options = parser.parse_args()
    run = _results.Run("simulator_speed")
    cv2.setNumThreads(1)
    rows = [
        row for name in options.scenario or ["S02_D4_A"] for row in timed(name, options.frames, options.scale)
    ]
    if options.results:
        run.save(options.results, rows=pd.DataFrame(rows))


def timed(name: str, num_frames: int, scale: float) -> list[dict[str, object]]:
    """Print the table of one scenario; return a row per stage, with processor milliseconds per frame."""
    _spent_s.clear()
    recipe = scenario(name)
    scene = build(recipe, scale=scale)
    width, height = (int(side) for side in scene.rig.cameras.image_size_wh[0])
    print(f"{recipe.name}: {len(recipe.drones)} drones, {width} x {height}, {num_frames} frames")
    print(f"{platform.processor() or platform.machine()}, OpenCV {cv2.__version__}, NumPy {np.__version__}")
    frames = range(num_frames)
    with tempfile.TemporaryDirectory() as folder:
        static_camera(scene, frames, Path(folder))
        if recipe.onboard is not None:
            onboard_camera(scene, frames, Path(folder))
    set_up_s, onboard_s = _spent_s.pop("set-up"), _spent_s.pop("on-board video", None)
    for stage_name, spent_s in _spent_s.items():
        print(f"{stage_name:30} {1e3 * spent_s / num_frames:7.1f} ms per frame")
    total_s = sum(_spent_s.values()) / num_frames
    print(f"{'total of a static camera':30} {1e3 * total_s:7.1f} ms per frame")
    print(f"{'one second of eight, two cores':30} {200 * total_s / 2:7.1f} s")
    if onboard_s is not None:
        print(f"{'video of an on-board camera':30} {1e3 * onboard_s / num_frames:7.1f} ms per frame")
    print(f"{'set-up, once per camera':30} {set_up_s:7.1f} s")
    spent_ms = {stage_name: 1e3 * spent_s / num_frames for stage_name, spent_s in _spent_s.items()}
    spent_ms |= {"total": 1e3 * total_s, "set-up": 1e3 * set_up_s}
    if onboard_s is not None:
        spent_ms["on-board video"] = 1e3 * onboard_s / num_frames
    return [
        {"scenario": name, "drones": len(recipe.drones), "stage": stage_name, "ms_per_frame": value}
        for stage_name, value in spent_ms.items()
    ]


if __name__ == "__main__":
    main()

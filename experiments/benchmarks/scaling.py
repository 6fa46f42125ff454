"""Cost per frame against cameras, drones, particles and image size, and what breaks first.

    python experiments/benchmarks/scaling.py
    python experiments/benchmarks/scaling.py --axes cameras drones --repeats 5
    python experiments/benchmarks/scaling.py --kept data/scaling --seconds 40        # call again until it is done
    python experiments/benchmarks/scaling.py --small --picture scaling.png --results results     # a minute, for a test

One quantity changes, and the others stay as they are: 8 cameras of 960 x 540 pixels at 25 frames per second, 4 drones,
30 particles for each drone. Each measurement is a process of its own, which draws videos, makes the silhouettes, tracks
from the reference's first frame, and prints the cost per instant, which is one frame of all cameras:

- front end: decoding and foreground, the first look at the videos included, in one process, processor milliseconds;
- start: the volume in which things move is found, processor seconds, once for a recording, and measured with few
  cameras and drones only, because it takes minutes with many; the other parts are given the volume and the reference's
  first positions;
- track: the swarm and the births of drones, milliseconds; the best of some repeats without compilation;
- finish: errors of the cameras, identities, smoothing, milliseconds; in the same way;
- meeting: frames of live cameras meet at an instant, milliseconds; in the same way;
- programs: number of compiled programs, and processor seconds that they took;
- memory: peak of the resident memory above that of the imported package, and the same of the front end alone.

Beside them stand the mean error of the tracks, the share of positions that were missed, and the share of frames that
were left out because foreground was everywhere in the image.
Processor time is that of all threads; other load of the machine hardly changes it.

A straight line through the logarithms gives each exponent, with its standard error. A fixed share of the cost makes an
exponent small. A part breaks where its line reaches its limit: 40 ms for an instant, as long as the cameras take (of
the front end for each processor), a minute of compilation, the memory of this machine.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import _scene
import cv2
import jax
import numpy as np
import pandas as pd

from psotrack.evaluation import evaluate
from psotrack.foreground.silhouettes import Silhouettes, compute
from psotrack.live import Meeting
from psotrack.pipeline import TrackedRecording, prepare, track_runs
from psotrack.recordings import CameraRecording, Recording, Reference, VideoWriter, probe
from psotrack.settings import TrackSettings
from psotrack.support import COLOURS, processors, save_figure
from psotrack.trajectories import Trajectories

if TYPE_CHECKING:
    from matplotlib.figure import Figure

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

#: Time in which the cameras take the frames of an instant, milliseconds.
INSTANT_MS = 1e3 / _scene.FPS
#: Longest start and longest compilation, seconds.
LONGEST_S = 60.0
#: Largest number of cameras times drones with which the start is measured.
MOST_AT_START = 80
#: No further repeat begins after this time, seconds.
REPEATING_S = 15.0
#: A part does not break on an axis if its line reaches the limit farther beyond the largest measurement.
FARTHEST = 100.0
#: Instants at which frames meet.
MEETINGS = 500


@dataclass(frozen=True)
class Shape:
    """What is measured.

    Attributes:
        cameras, drones: numbers of cameras and drones.
        particles: particles of the swarm of each drone.
        width: width of the images, pixels; the height is 9/16 of it.
        frames: frames of each video.
    """

    cameras: int = 8
    drones: int = 4
    particles: int = 30
    width: int = 960
    frames: int = 50

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height of the images, pixels; even, as the codec needs."""
        return self.width, 2 * round(self.width * 9 / 32)


#: Values on each axis.
AXES = {
    "cameras": (2, 4, 8, 16, 32, 64),
    "drones": (1, 2, 5, 10, 20, 50),
    "particles": (10, 30, 100, 300),
    "width": (480, 960, 1440, 1920),
}
#: A minute: three values on two axes, few frames.
SMALL_AXES = {"cameras": (2, 3, 4), "drones": (1, 2, 3), "particles": (8,), "width": (320,)}
SMALL = Shape(cameras=3, drones=2, particles=8, width=320, frames=30)


@dataclass(frozen=True)
class Part:
    """A part of the work.

    Attributes:
        title: words for it.
        column: column of its cost.
        unit: unit of the cost.
        limit: largest cost, on this machine.
    """

    title: str
    column: str
    unit: str
    limit: float


def parts() -> dict[str, Part]:
    """All parts, by name."""
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return {
        "front end": Part("front end", "front_end_ms", "processor ms", INSTANT_MS * processors()),
        "track": Part("track", "track_ms", "ms", INSTANT_MS),
        "finish": Part("finish", "finish_ms", "ms", INSTANT_MS),
        "meeting": Part("meeting of frames", "meeting_ms", "ms", INSTANT_MS),
        "programs": Part("programs", "compile_s", "processor s to compile", LONGEST_S),
        "start": Part("start", "start_s", "processor s", LONGEST_S),
        "memory": Part("memory", "memory_gb", "GB", memory_gb),
    }


def main() -> None:
    """Measure, fit, print, draw and save."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--axes", nargs="+", choices=AXES, default=list(AXES), help="what changes")
    parser.add_argument("--repeats", type=int, default=6, help="timings of which the best one counts")
    parser.add_argument("--small", action="store_true", help="few small values: for a test of this program")
    parser.add_argument("--picture", type=Path, default=Path("experiments/pictures/scaling.png"))
    parser.add_argument("--results", type=Path, help="write the result and its record into this folder")
    parser.add_argument("--kept", type=Path, help="keep measurements in this folder; the same call continues")
    parser.add_argument(
        "--seconds", type=float, default=math.inf, help="begin no measurement after this time"
    )
    options = parser.parse_args()
    run = _results.Run("scaling")
    axes, usual = (SMALL_AXES, SMALL) if options.small else (AXES, Shape())
    kept = None if options.kept is None else options.kept / f"{run.code_state}.json"
    chosen = {axis: axes[axis] for axis in options.axes}
    rows = pd.DataFrame(measured(chosen, usual, options.repeats, kept, options.seconds))
    fits = fitted(rows)
    broken = breaking(rows, fits)
    print_results(rows, fits, broken)
    save_figure(options.picture, (11, 7), lambda figure: draw(figure, rows, fits), force=True)
    if options.results:
        figures = {"usual": asdict(usual), "exponents": fits, "breaks": broken, "processors": processors()}
        run.save(options.results, rows=rows, figures=figures, files=[options.picture])


def measured(
    axes: Mapping[str, Sequence[int]], usual: Shape, repeats: int, kept: Path | None, most_s: float
) -> list[dict[str, Any]]:
    """One row for each value of each axis. What two axes share is measured once.

    Args:
        axes: values on each axis.
        usual: what does not change.
        repeats: timings of which the best one counts.
        kept: file of measurements of earlier calls in the same state of the code, which is continued; None keeps none.
        most_s: time after which no measurement begins, seconds; the program then ends, and says so.
    """
    began = time.monotonic()
    known = json.loads(kept.read_text(encoding="utf-8")) if kept is not None and kept.exists() else {}
    shapes = {
        (axis, value): replace(usual, **{axis: value}) for axis, values in axes.items() for value in values
    }
    spawn = multiprocessing.get_context("spawn")
    for shape in dict.fromkeys(shapes.values()):
        if str(shape) in known:
            continue
        if time.monotonic() - began > most_s:
            sys.exit(f"scaling: {len(known)} measurements are done; the same call measures the others")
        # A process of its own, so that its peak of memory is that of this shape alone.
        with ProcessPoolExecutor(1, mp_context=spawn) as process:
            known[str(shape)] = process.submit(measure, shape, repeats).result()
        print(shape, {key: round(cost, 3) for key, cost in known[str(shape)].items()}, flush=True)
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(known), encoding="utf-8")
    return [
        {"axis": axis, "value": value, **asdict(shape), **known[str(shape)]}
        for (axis, value), shape in shapes.items()
    ]


def measure(shape: Shape, repeats: int) -> dict[str, float]:
    """Costs of one shape; run it in a process of its own."""
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: compiled.append(event) if "backend_compile" in event else None
    )
    scene = _scene.formation(shape.frames, shape.drones, shape.cameras, shape.size_wh)
    with tempfile.TemporaryDirectory() as folder:
        recording = write_recording(scene, shape, Path(folder))
        before_gb, began = peak_gb(), time.process_time()
        silhouettes = compute(recording, TrackSettings().silhouettes, cache=Path(folder) / "cache", jobs=1)
        front_end_s, front_end_gb = time.process_time() - began, peak_gb() - before_gb
        settings = TrackSettings(init="truth").changed({"swarm.particles": shape.particles})
        runs: list[TrackedRecording] = []
        processor_s = []
        spent_s = 0.0
        # The first run compiles.
        while len(runs) < 2 or (len(runs) <= repeats and spent_s < REPEATING_S):
            began = time.process_time()
            (tracked,) = track_runs(recording, silhouettes, [settings])
            processor_s.append(time.process_time() - began)
            if not isinstance(tracked, TrackedRecording):
                raise tracked
            spent_s += processor_s[-1] if runs else 0.0
            runs.append(tracked)
        few = shape.cameras * shape.drones <= MOST_AT_START
        found_s = start_s(recording, silhouettes) if few else math.nan
    assert recording.truth is not None
    judged = evaluate(runs[-1].trajectories, recording.truth).to_dict()
    left_out = sum(stop - start for of_camera in silhouettes.left_out.values() for start, stop in of_camera)
    per_instant = 1e3 / shape.frames
    seconds = [run.record["seconds"] for run in runs[1:]]
    return {
        "front_end_ms": per_instant * front_end_s,
        "start_s": found_s,
        "track_ms": per_instant * min(each["track"] for each in seconds),
        "finish_ms": per_instant * min(each["finish"] for each in seconds),
        "meeting_ms": min(meeting_ms(shape.cameras) for _ in range(repeats)),
        "programs": float(len(compiled)),
        "compile_s": processor_s[0] - min(processor_s[1:]),
        "memory_gb": peak_gb() - before_gb,
        "front_end_gb": front_end_gb,
        "mean_error_mm": 1e3 * judged["mean_error_m"],
        "missed_rate": judged["missed_rate"],
        "left_out_rate": left_out / (shape.cameras * shape.frames),
        "load_average": os.getloadavg()[0],
    }


def write_recording(scene: _scene.Scene, shape: Shape, folder: Path) -> Recording:
    """Draw the videos of a scene: dark drones before a patterned wall, with noise."""
    generator = np.random.default_rng(0)
    width, height = shape.size_wh
    coarse = generator.integers(90, 200, (9, 16, 3)).astype(np.uint8)
    wall = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    noise = [generator.normal(0, 2, wall.shape).round().astype(np.int8) for _ in range(5)]
    # Noise comes again in another order, because drawing noise takes longer than all else.
    walls = [np.clip(wall.astype(np.int16) + each, 0, 255).astype(np.uint8) for each in noise]
    order = generator.integers(len(walls), size=(shape.cameras, shape.frames))

    def write(camera: int) -> Path:
        path = folder / f"{scene.rig.names[camera]}.avi"
        with VideoWriter(path, _scene.FPS, shape.size_wh) as writer:
            for frame in range(shape.frames):
                writer.write(scene.picture(walls[order[camera, frame]], camera, frame))
        return path

    with ThreadPoolExecutor(processors()) as threads:
        paths = list(threads.map(write, range(shape.cameras)))
    truth = Trajectories(
        frame=np.arange(shape.frames),
        time_s=np.arange(shape.frames) / _scene.FPS,
        drones=tuple(f"drone{drone}" for drone in range(shape.drones)),
        position_m=scene.position_m,
    )
    videos = {name: probe(path) for name, path in zip(scene.rig.names, paths, strict=True)}
    bounds_m = tuple(float(side) for side in _scene.BOUNDS_M.T.ravel())
    cameras = tuple(
        CameraRecording(name, scene.rig.cameras[index], video)
        for index, (name, video) in enumerate(videos.items())
    )
    recording = Recording("scaling", folder, cameras, Reference(truth), bounds_m=bounds_m)
    return recording.usable(num_frames=None)


def start_s(recording: Recording, silhouettes: Silhouettes) -> float:
    """Processor seconds until the volume is found, when it is not given."""
    recording = replace(recording, bounds_m=None)
    silhouettes = silhouettes.at_instants(recording.timeline())
    began = time.process_time()
    prepare(recording, silhouettes, {}, TrackSettings(), {})
    return time.process_time() - began


def meeting_ms(num_cameras: int) -> float:
    """Milliseconds in which the frames of an instant meet, without what is done with them."""
    meeting = Meeting([_scene.FPS] * num_cameras, _scene.FPS, wait_s=0.1)
    image, taken = np.zeros((1, 1), np.uint8), 0
    began = time.perf_counter()
    for number in range(MEETINGS):
        time_s = number / _scene.FPS
        for camera in range(num_cameras):
            meeting.announce(camera, time_s, time_s)
            meeting.put(camera, time_s, image, time_s)
            # A session asks after each frame.
            while meeting.take(time_s) is not None:
                taken += 1
    spent_s = time.perf_counter() - began
    assert taken > MEETINGS // 2, "the frames did not meet"
    return 1e3 * spent_s / MEETINGS


def fitted(rows: pd.DataFrame) -> dict[str, dict[str, dict[str, float]]]:
    """Exponent, its standard error, and the factor, by axis and part. Fewer than three values have none.

    The standard error contains noise and how far the cost is from a power.
    """
    fits: dict[str, dict[str, dict[str, float]]] = {}
    for axis, of_axis in rows.groupby("axis", sort=False):
        fits[str(axis)] = {}
        for name, part in parts().items():
            known = of_axis[of_axis[part.column].notna()]
            if len(known) < 3:
                continue
            x = np.log(known["value"].to_numpy(float))
            y = np.log(np.maximum(known[part.column].to_numpy(float), 1e-6))
            design = np.stack([x, np.ones_like(x)], axis=-1)
            (exponent, factor), *_ = np.linalg.lstsq(design, y)
            left = y - design @ (exponent, factor)
            variance = left @ left / (len(x) - 2) / np.square(x - x.mean()).sum()
            fits[str(axis)][name] = {
                "exponent": float(exponent),
                "standard_error": float(np.sqrt(variance)),
                "factor": float(np.exp(factor)),
            }
    return fits


def breaking(
    rows: pd.DataFrame, fits: Mapping[str, Mapping[str, Mapping[str, float]]]
) -> dict[str, list[dict[str, Any]]]:
    """Where each part reaches its limit, by axis, the first one first; `measured` says if a measurement reaches it."""
    found: dict[str, list[dict[str, Any]]] = {}
    for axis, of_parts in fits.items():
        values = rows.loc[rows["axis"] == axis, "value"]
        found[axis] = []
        for name, fit in of_parts.items():
            part = parts()[name]
            # A cost that does not grow never reaches its limit.
            if fit["exponent"] <= 2 * fit["standard_error"]:
                continue
            log_at = (math.log(part.limit) - math.log(fit["factor"])) / fit["exponent"]
            if log_at > math.log(FARTHEST * values.max()):
                continue
            at = math.exp(log_at)
            found[axis].append({"part": name, "at": at, "measured": bool(at <= values.max())})
        found[axis].sort(key=lambda one: one["at"])
    return found


def print_results(
    rows: pd.DataFrame,
    fits: Mapping[str, Mapping[str, Mapping[str, float]]],
    broken: Mapping[str, Sequence[Mapping[str, Any]]],
) -> None:
    """Print a table for each axis, the exponents, and what breaks first."""
    columns = ["value", *(part.column for part in parts().values())]
    columns += ["programs", "front_end_gb", "mean_error_mm", "missed_rate", "left_out_rate", "load_average"]
    for axis, of_axis in rows.groupby("axis", sort=False):
        print(f"\n{axis}\n{of_axis[columns].to_string(index=False, float_format='{:.3g}'.format)}")
        for name, fit in fits.get(str(axis), {}).items():
            print(f"{name:10} {axis} ^ {fit['exponent']:.2f} ± {fit['standard_error']:.2f}")
        for one in broken.get(str(axis), []):
            part = parts()[one["part"]]
            sure = "" if one["measured"] else ", beyond what was measured"
            print(
                f"{part.title} reaches its limit, {part.limit:.3g} {part.unit}, at {one['at']:.3g} {axis}{sure}"
            )
    print(f"\nprocessors: {processors()}. A part without a line reaches its limit nowhere near.")


def draw(figure: Figure, rows: pd.DataFrame, fits: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    """One panel for each axis, one line for each part that takes time."""
    shown = [name for name, part in parts().items() if part.column.endswith("_ms")]
    titles = {"width": "width of the images, pixels", "particles": "particles for each drone"}
    axes = list(rows.groupby("axis", sort=False))
    panels = figure.subplots(1 + (len(axes) - 1) // 2, min(2, len(axes)), squeeze=False).flat
    for panel, (axis, of_axis) in zip(panels, axes, strict=False):
        for colour, name in zip(COLOURS, shown, strict=False):
            part = parts()[name]
            label = f"{part.title}, {part.unit}"
            if fit := fits.get(str(axis), {}).get(name):
                label += f": exponent {fit['exponent']:.2f} ± {fit['standard_error']:.2f}"
                ends = np.array([of_axis["value"].min(), of_axis["value"].max()], float)
                panel.plot(ends, fit["factor"] * ends ** fit["exponent"], color=colour, linewidth=1)
            panel.plot(of_axis["value"], of_axis[part.column], "o", color=colour, label=label, markersize=4)
        panel.axhline(INSTANT_MS, color="#999999", linewidth=0.8, linestyle="--")
        panel.set(xscale="log", yscale="log", xlabel=titles.get(str(axis), axis), ylabel="ms per instant")
        panel.set_xticks(of_axis["value"], [f"{value}" for value in of_axis["value"]])
        panel.minorticks_off()
        panel.legend(fontsize=7)
        panel.grid(alpha=0.3)


def peak_gb() -> float:
    """Largest resident memory of this process so far, 10^9 bytes."""
    # The unit is KiB on Linux and bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


if __name__ == "__main__":
    main()

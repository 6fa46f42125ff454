"""From videos to tracks, stage by stage, beside decoding alone and OpenCV's MOG2 alone: is it as fast as the cameras?

    python experiments/benchmarks/end_to_end.py --data data
    python experiments/benchmarks/end_to_end.py --data data --cases "4 drones, 10 s" --repeats 3

Each case is a recording of eight cameras of 1920 x 1080 pixels at 25 frames per second. `psotrack track` runs in a
process of its own, with an empty cache of silhouettes and a warm cache of compiled programs. Its real-time factor, from
the record, counts everything from the start of the program to the last row. In the same run two floors are measured in
as many processes as there are processors: decoding the videos to BGR frames alone, and MOG2 alone on frames of the size
that the background model sees. The front end is decoding and foreground together, in seconds summed over processes.

The recordings are simulated unless they exist (some minutes each), in MPEG-4. Where the program `ffmpeg` has an encoder
for H.264, the videos are encoded once more with it, and these are used.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from psotrack.foreground.silhouettes import reduce_frame, scaled_settings
from psotrack.recordings import Recording, VideoInfo, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate
from psotrack.support import Advance, map_in_processes, progress_bar

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

FPS = 25
#: Frames of one camera on which MOG2 is timed, held in memory.
_HELD = 100
#: Encoders of H.264 that FFmpeg may have, in order of preference, and their options: the quality of a good camera.
_ENCODERS = {
    "libx264": ("-preset", "fast", "-crf", "23"),
    "libopenh264": ("-b:v", "6M"),
    "h264_videotoolbox": ("-b:v", "6M"),
}


@dataclass(frozen=True)
class Case:
    """A recording that is tracked.

    Attributes:
        scenario: name of the scenario that is simulated.
        seconds: seconds of video that are tracked.
        least_factor: real-time factor that is to be reached.
    """

    scenario: str
    seconds: int
    least_factor: float


CASES = {
    "4 drones, 10 s": Case("S02_D4_A", 10, 1.0),
    "4 drones, 60 s": Case("S02_D4_A", 60, 1.3),
    "10 drones, 60 s": Case("S03_D10_A", 60, 1.0),
}
#: Seconds of video that are simulated, and smallest distance of two drones: on longer flights they come nearer.
_SIMULATED_S, _MIN_DISTANCE_M = 60, 0.3


def main() -> None:
    """Measure all cases, print a table for each, and save the result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the recordings")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="names of the cases")
    parser.add_argument(
        "--sequence", type=Path, help="a recording of your own instead of the cases, with all its frames"
    )
    parser.add_argument("--codec", choices=["auto", "mpeg4"], default="auto", help="auto: H.264 if possible")
    parser.add_argument("--background", default=TrackSettings().silhouettes.background)
    parser.add_argument("--repeats", type=int, default=1, help="runs of each case; medians are printed")
    parser.add_argument("--results", type=Path, help="write the result and its record into this folder")
    options = parser.parse_args()
    run = _results.Run("end_to_end")
    print(json.dumps(_results.machine() | {"versions": _results.versions()}))
    if options.sequence is not None:
        cases = {options.sequence.name: (options.sequence, None, None)}
    else:
        cases = {
            name: (made(CASES[name].scenario, options.data, options.codec), CASES[name].seconds, CASES[name])
            for name in options.cases
        }
    rows = []
    for name, (folder, seconds, case) in cases.items():
        row = measured(folder, seconds, options.background, options.repeats)
        rows.append({"case": name, "least_factor": None if case is None else case.least_factor, **row})
        _print(rows[-1])
    if options.results:
        run.save(options.results, rows=pd.DataFrame(rows), figures={"processors": _processes()})


def made(name: str, data: Path, codec: str) -> Path:
    """The folder of a simulated recording, which is made if it is missing; with videos in H.264 if possible."""
    folder = data / "end_to_end" / "Simulated_Data" / name
    if not folder.exists():
        print(f"simulating {folder}", flush=True)
        recipe = change_scenario(
            scenario(name),
            {"num_frames": _SIMULATED_S * FPS, "limits.min_distance_m": _MIN_DISTANCE_M},
        )
        simulate(
            recipe, folder.parents[1], SimulationSettings(masks=False, onboard=False), report=progress_bar
        )
    encoder = _encoder() if codec == "auto" else None
    return folder if encoder is None else _encoded(folder, encoder)


def _encoder() -> str | None:
    """An encoder for H.264 that the program FFmpeg has."""
    if shutil.which("ffmpeg") is None:
        return None
    listed = subprocess.run(
        ["ffmpeg", "-hide_banner", "-encoders"], capture_output=True, text=True, check=False
    )
    return next((name for name in _ENCODERS if f" {name} " in listed.stdout), None)


def _encoded(folder: Path, encoder: str) -> Path:
    """The recording with its videos encoded once more."""
    encoded = folder.parents[2] / "end_to_end_h264" / "Simulated_Data" / folder.name
    if encoded.exists():
        return encoded
    print(f"encoding {encoded} by {encoder}", flush=True)
    partial = encoded.with_name(f".{encoded.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    shutil.copytree(folder, partial, ignore=shutil.ignore_patterns("*.avi"))
    for video in sorted(folder.glob("*.avi")):
        command = ["ffmpeg", "-v", "error", "-i", f"{video}", "-c:v", encoder, *_ENCODERS[encoder]]
        subprocess.run([*command, f"{partial / video.stem}.mp4"], check=True)
    partial.rename(encoded)
    return encoded


def measured(folder: Path, seconds: int | None, background: str, repeats: int) -> dict[str, Any]:
    """Real-time factors, seconds of all stages, and floors of one recording; medians of some runs."""
    num_frames = None if seconds is None else seconds * FPS
    recording = open_recording(folder).usable(num_frames=num_frames)
    with tempfile.TemporaryDirectory() as cache:
        _track(folder, recording.num_frames, background, Path(cache))  # compiles
        tracked = []
        for _ in range(repeats):
            for stored in Path(cache).iterdir():
                if stored.name != "compiled":
                    shutil.rmtree(stored)
            tracked.append(_track(folder, recording.num_frames, background, Path(cache)))
        floor = _floor(recording)
    stages = {
        f"{name}_s": statistics.median(one["seconds"][name] for one in tracked)
        for name in tracked[0]["seconds"]
    }
    front_s = stages["decode_s"] + stages["foreground_s"]
    return {
        "drones": len(tracked[0]["drones"]),
        "video_s": recording.num_frames / recording.fps,
        "frames": recording.num_frames,
        "cameras": len(recording.rig),
        "codec": codec_of(next(iter(recording.videos.values()))),
        "real_time_factor": statistics.median(one["real_time_factor"] for one in tracked),
        "real_time_factor_running": statistics.median(one["real_time_factor_running"] for one in tracked),
        **stages,
        "floor_decode_s": floor["decode"],
        "floor_mog2_s": floor["mog2"],
        "front_ratio": front_s / (floor["decode"] + floor["mog2"]),
        "load_average": os.getloadavg()[0],
    }


def _track(folder: Path, num_frames: int, background: str, cache: Path) -> dict[str, Any]:
    """The record of a run of `psotrack track`."""
    out = cache.parent / f"{cache.name}.tracks.csv"
    command = [
        sys.executable,
        "-m",
        "psotrack",
        "track",
        f"{folder}",
        "--out",
        f"{out}",
        "--quiet",
        "--force",
    ]
    options = ["--frames", f"{num_frames}", "--background", background, "--cache", f"{cache}"]
    try:
        subprocess.run([*command, *options], check=True)
        return json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    finally:
        for written in (out, out.with_suffix(".json"), out.with_suffix(".ambiguity.csv")):
            written.unlink(missing_ok=True)


@dataclass(frozen=True)
class _FloorTask:
    """A video, and the factor by which its frames are reduced for MOG2."""

    video: VideoInfo
    reduction: int


def _floor(recording: Recording) -> dict[str, float]:
    """Seconds of decoding alone and of MOG2 alone, summed over processes."""
    scaled = scaled_settings(TrackSettings().silhouettes, recording)
    tasks = [_FloorTask(video, scaled.working_reduction) for video in recording.videos.values()]
    floors = map_in_processes(_time_floor, tasks, jobs=_processes(), advance=lambda steps: None)
    return {name: sum(one[name] for one in floors) for name in ("decode", "mog2")}


def _time_floor(task: _FloorTask, advance: Advance) -> dict[str, float]:
    began = time.perf_counter()
    for _ in read_frames(task.video):
        advance(1)
    decode_s = time.perf_counter() - began
    settings = TrackSettings().silhouettes.scaled([task.video.image_size_wh])
    settings = type(settings)(working_reduction=task.reduction, reduction=task.reduction)
    held = [reduce_frame(frame, settings) for frame in itertools.islice(read_frames(task.video), _HELD)]
    model = cv2.createBackgroundSubtractorMOG2()
    began = time.perf_counter()
    for frame in held:
        model.apply(frame)
    mog2_s = time.perf_counter() - began
    return {"decode": decode_s, "mog2": mog2_s * task.video.num_frames / len(held)}


def codec_of(video: VideoInfo) -> str:
    """Name of a video's codec, four letters."""
    capture = cv2.VideoCapture(str(video.path.resolve()), cv2.CAP_FFMPEG)
    code = int(capture.get(cv2.CAP_PROP_FOURCC))
    capture.release()
    return np.array([code], "<u4").tobytes().decode(errors="replace")


def _processes() -> int:
    return os.cpu_count() or 1


def _print(row: dict[str, Any]) -> None:
    print(
        f"\n{row['case']}: {row['cameras']} cameras, {row['frames']} frames, {row['codec']}, "
        f"load {row['load_average']:.1f}"
    )
    least = "" if row["least_factor"] is None else f" (to reach: {row['least_factor']:g})"
    print(
        f"real-time factor {row['real_time_factor']:.2f}{least}, "
        f"{row['real_time_factor_running']:.2f} without start and compilation"
    )
    stages = ("decode", "foreground", "compile", "track", "finish", "total")
    print("seconds:      " + "  ".join(f"{stage} {row[f'{stage}_s']:.2f}" for stage in stages))
    print(
        f"floor:        decode {row['floor_decode_s']:.2f}  MOG2 {row['floor_mog2_s']:.2f}  "
        f"front end {row['front_ratio']:.2f} times both (to reach: 1.4)",
        flush=True,
    )


if __name__ == "__main__":
    main()

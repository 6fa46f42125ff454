"""How fast psotrack is: from videos to tracks, live, and many runs at once.

    python experiments/benchmark.py videos --data data     # `make bench-videos`, ten minutes
    python experiments/benchmark.py live --data data       # `make bench-live`, a minute
    python experiments/benchmark.py batch --data data      # `make bench-batch`, eight minutes
    python experiments/benchmark.py batch --device gpu

All measure on ten seconds of eight cameras of 1920 x 1080 pixels and four drones, which are simulated if missing and
encoded as H.264 by FFmpeg, or on a recording of your own (--sequence). `videos` tracks these and sixty seconds with no
stored silhouettes, after a run that compiled and stored the programs; the floor is the time in which OpenCV decodes the
same videos and its MOG2 sees their frames. `live` replays the videos at their own rate and measures how long the rows
come after the last frame. `batch` times 64 runs at once beside one run, without silhouettes and compilation.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import _results
import cv2
import msgspec
import numpy as np
import pandas as pd
import psutil
from _sequences import simulated

from psotrack.recordings import VideoInfo
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import SimulationSettings, scenario, simulate
from psotrack.support import progress_bar


def main() -> None:
    """Measure, print, and save the result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=MEASURES)
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the recordings")
    parser.add_argument("--sequence", type=Path, help="a recording of your own")
    parser.add_argument("--runs", type=int, default=64, help="batch: runs at once")
    parser.add_argument("--backgrounds", nargs="+", default=["living", "mog2"], help="videos: models")
    parser.add_argument("--frames", type=int, help="number of first frames [default: all]")
    parser.add_argument("--repeats", type=int, default=2, help="timed repeats; medians are printed")
    parser.add_argument("--device", choices=["cpu", "gpu"], help="batch: where it computes")
    parser.add_argument("--results", type=Path, help="write the result and its record into this folder")
    options = parser.parse_args()
    name, measure = MEASURES[options.what]
    run = _results.Run(name)
    rows, figures = measure(options)
    print(
        pd.DataFrame(rows).to_string(index=False, float_format="%.3g")
        if rows
        else json.dumps(figures, indent=1)
    )
    if options.results:
        run.save(options.results, rows=pd.DataFrame(rows) if rows else None, figures=figures)


def videos(options: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Real-time factors and seconds of all stages, from the videos to the tracks, beside the floor."""
    rows = []
    for seconds, background in itertools.product([0] if options.sequence else [10, 60], options.backgrounds):
        sequence = options.sequence or h264(options.data, seconds)
        recording = open_recording(sequence).usable(num_frames=options.frames)
        words = ("track", sequence, "--frames", recording.num_frames, "--background", background)
        runs, peak_mb = [], 0.0
        with tempfile.TemporaryDirectory() as cache:
            for _ in range(options.repeats + 1):
                for stored in Path(cache).iterdir():
                    if stored.name != "compiled":
                        shutil.rmtree(stored)
                # The first one compiles; whoever asks for its memory takes some of its time.
                record, most_mb = _record_of(words, Path(cache), ask_s=0.0 if runs else 0.5)
                runs.append(record)
                peak_mb = max(peak_mb, most_mb)
        timed = pd.DataFrame(map(_walls, runs[1:])).median()
        floor_s = _floor_s(list(recording.videos.values()), len(os.sched_getaffinity(0)))
        rows.append(
            {
                "video_s": recording.num_frames / recording.fps,
                "background": background,
                "drones": len(runs[-1]["drones"]),
                **timed,
                "floor_s": floor_s,
                "front_end_to_floor": timed.silhouettes_s / floor_s,
                "cold_s": runs[0]["seconds"]["total"],
                "peak_mb": peak_mb,
            }
        )
    return rows, {"recording": recording.name, "cameras": len(recording.rig)}


def _walls(record: dict[str, Any]) -> dict[str, float]:
    """Seconds of wall clock of each stage of a run, those in which the processes of silhouettes waited, and factors."""
    seconds = record["seconds"]
    stages = {stage: seconds[stage] for stage in ("silhouettes", "volume", "compile", "track", "finish")}
    busy_s = seconds["decode"] + seconds["foreground"]
    return {
        "start_and_end_s": seconds["total"] - sum(stages.values()),
        **{f"{stage}_s": spent for stage, spent in stages.items()},
        "decode_s_of_processes": seconds["decode"],
        "foreground_s_of_processes": seconds["foreground"],
        "waiting_s_of_processes": len(os.sched_getaffinity(0)) * seconds["silhouettes"] - busy_s,
        "total_s": seconds["total"],
        "factor": record["real_time_factor"],
    }


def _floor_s(videos: list[VideoInfo], processes: int) -> float:
    """Seconds in which OpenCV decodes the videos, and its MOG2 sees their frames at a quarter of the size."""
    paths = [str(video.path.resolve()) for video in videos]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        pool.map(_floor, paths[:1] * processes)  # the processes have started
        began = time.perf_counter()
        pool.map(_floor, paths, chunksize=1)
        return time.perf_counter() - began


def _floor(path: str) -> None:
    cv2.setNumThreads(1)
    capture = cv2.VideoCapture(path, cv2.CAP_FFMPEG, (cv2.CAP_PROP_N_THREADS, 1))
    model, (read, frame) = cv2.createBackgroundSubtractorMOG2(), capture.read()
    while read:
        height, width = frame.shape[:2]
        half = cv2.resize(frame, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        model.apply(cv2.resize(half, (width // 4, height // 4), interpolation=cv2.INTER_AREA))
        read, frame = capture.read(frame)


def h264(data: Path, seconds: int = 10) -> Path:
    """The simulated flight of some seconds in H.264, as most cameras write it, made by FFmpeg."""
    out = data / "h264" / f"{seconds}" / "S02_D4_A"
    if out.exists():
        return out
    if seconds == 10:
        folder = simulated("S02_D4_A", data, 0)
    elif not (folder := data / f"{seconds}s" / "Simulated_Data" / "S02_D4_A").exists():
        recipe = scenario("S02_D4_A")
        limits = msgspec.structs.replace(recipe.limits, min_distance_m=0.4)
        recipe = msgspec.structs.replace(recipe, num_frames=round(seconds * recipe.fps), limits=limits)
        settings = SimulationSettings(masks=False, onboard=False)
        simulate(recipe, folder.parents[1], settings, report=progress_bar)
    part = out.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    shutil.copy(folder / "cameras_calibration.csv", part)
    for video in sorted(folder.glob("cam*.avi")):
        print(f"encoding {out / video.stem}.mp4", flush=True)
        if shutil.which("ffmpeg") is None:
            sys.exit("benchmark: expected FFmpeg, which encodes videos, found none; or pass --sequence")
        encode = "ffmpeg", "-v", "error", "-y", "-i", video, "-c:v", "libx264", part / f"{video.stem}.mp4"
        subprocess.run(list(map(str, encode)), check=True)
    return part.rename(out)


def live(options: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Delay from the last camera's frame to the row."""
    rows, folder = [], options.sequence or h264(options.data)
    fps = open_recording(folder).fps
    seconds = () if options.frames is None else ("--seconds", f"{options.frames / fps}")
    with tempfile.TemporaryDirectory() as cache:
        _record_of(("live", folder, "--replay", "--seconds", "2"), Path(cache))  # compiles
        for _ in range(options.repeats):
            record, _ = _record_of(("live", folder, "--replay", *seconds), Path(cache))
            delay_s, frames = record["delay_s"], record["camera_frames"].values()
            rows.append(
                {
                    **{
                        f"{key}_ms": 1e3 * delay_s[name]
                        for key, name in (("median", "median"), ("p99", "p99"), ("max", "max"))
                    },
                    "instants": record["frames"],
                    "instants_left_out": record["frames_left_out"],
                    "frames_left_out": sum(each["left_out"] for each in frames),
                }
            )
    print("to reach: median 30 ms, 99 % 60 ms, no frame left out")
    return rows, {}


def batch(options: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Seconds of some runs at once, and of one run."""
    from psotrack.foreground.silhouettes import compute
    from psotrack.pipeline import track_runs
    from psotrack.settings import TrackSettings
    from psotrack.support import use_device

    if options.device:
        use_device(options.device)
    sequence = options.sequence or simulated("S02_D4_A", options.data, 0)
    recording = open_recording(sequence).usable(num_frames=options.frames)
    silhouettes = compute(recording, TrackSettings().silhouettes, cache=options.data / "silhouettes")
    seconds: dict[int, dict[str, float]] = {}
    for runs in (1, options.runs):
        settings, timed = [TrackSettings(seed=seed) for seed in range(runs)], []
        for _ in range(options.repeats + 1):
            began = time.perf_counter()
            track_runs(recording, silhouettes, settings)
            timed.append(time.perf_counter() - began)
        seconds[runs] = {"total": float(np.median(timed[1:]))}  # the first one compiles
    one_s, many_s = seconds[1], seconds[options.runs]
    figures = {
        "sequence": recording.name,
        "frames": recording.num_frames,
        "runs": options.runs,
        "particles": TrackSettings().swarm.particles,
        "iterations": TrackSettings().swarm.iterations,
        "one_s": one_s,
        "many_s": many_s,
        "ratio": many_s["total"] / one_s["total"],
    }
    return [], figures


MEASURES = {"videos": ("speed", videos), "live": ("live", live), "batch": ("batch", batch)}


def _record_of(words: tuple[object, ...], cache: Path, *, ask_s: float = 0.0) -> tuple[dict[str, Any], float]:
    """The record of a command that writes tracks, run in a program of its own, and its memory at most, megabytes.

    Memory that processes share counts once; it is asked for every `ask_s` seconds, or never.
    """
    with tempfile.TemporaryDirectory() as out:
        tracks, peak = Path(out) / "tracks.csv", 0
        command = [sys.executable, "-m", "psotrack", *map(str, words), "--out", str(tracks)]
        with subprocess.Popen([*command, "--cache", str(cache), "--quiet"]) as program:
            while ask_s and program.poll() is None:
                time.sleep(ask_s)
                with contextlib.suppress(psutil.Error):  # one has just ended
                    process = psutil.Process(program.pid)
                    tree = [process, *process.children(recursive=True)]
                    peak = max(peak, sum(each.memory_full_info().pss for each in tree))
        if program.returncode:
            sys.exit(program.returncode)
        return json.loads(tracks.with_suffix(".json").read_text(encoding="utf-8")), peak / 1e6


if __name__ == "__main__":
    main()

"""How fast psotrack is: from videos to tracks, live, and many runs at once.

    python experiments/benchmark.py videos --data data     # `make bench-videos`, three minutes
    python experiments/benchmark.py live --data data       # `make bench-live`, a minute
    python experiments/benchmark.py batch --data data      # `make bench-batch`, eight minutes
    python experiments/benchmark.py batch --device gpu

All measure on ten seconds of eight cameras of 1920 x 1080 pixels and four drones, which are simulated if missing,
or on a recording of your own (--sequence). `videos` tracks with no stored silhouettes, after a run that compiled and
stored the programs. `live` replays the videos at their own rate and measures how long the rows come after the last
frame. `batch` times 64 runs at once beside one run, without silhouettes and compilation.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import _results
import cv2
import numpy as np
import pandas as pd
from _sequences import simulated

from psotrack.recordings import VideoInfo
from psotrack.recordings.datasets import open_recording


def main() -> None:
    """Measure, print, and save the result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=MEASURES)
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the recordings")
    parser.add_argument("--sequence", type=Path, help="a recording of your own")
    parser.add_argument("--runs", type=int, default=64, help="batch: runs at once")
    parser.add_argument("--frames", type=int, help="number of first frames [default: all]")
    parser.add_argument("--repeats", type=int, default=2, help="timed repeats; medians are printed")
    parser.add_argument("--device", choices=["cpu", "gpu"], help="batch: where it computes")
    parser.add_argument("--results", type=Path, help="write the result and its record into this folder")
    options = parser.parse_args()
    name, measure = MEASURES[options.what]
    run = _results.Run(name)
    folder = options.sequence or simulated("S02_D4_A", options.data, 0)
    rows, figures = measure(folder, options)
    print(
        pd.DataFrame(rows).to_string(index=False, float_format="%.3g")
        if rows
        else json.dumps(figures, indent=1)
    )
    if options.results:
        run.save(options.results, rows=pd.DataFrame(rows) if rows else None, figures=figures)


def videos(folder: Path, options: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Real-time factors and seconds of all stages, from the videos to the tracks."""
    recording = open_recording(folder).usable(num_frames=options.frames)
    records = []
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(options.repeats + 1):
            for stored in Path(cache).iterdir():
                if stored.name != "compiled":
                    shutil.rmtree(stored)
            words = ("track", folder, "--frames", recording.num_frames)
            records.append(_record_of(words, Path(cache)))
    factors = ("real_time_factor", "real_time_factor_running")
    # The first one compiles.
    timed = pd.DataFrame(
        {
            **{f"{stage}_s": seconds for stage, seconds in record["seconds"].items()},
            **{key: record[key] for key in factors},
        }
        for record in records[1:]
    ).median()
    row = {
        "recording": recording.name,
        "drones": len(records[-1]["drones"]),
        "video_s": recording.num_frames / recording.fps,
        "cameras": len(recording.rig),
        "codec": _codec(next(iter(recording.videos.values()))),
        **timed,
    }
    return [row], {}


def live(folder: Path, options: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Delay from the last camera's frame to the row."""
    rows = []
    fps = open_recording(folder).fps
    seconds = () if options.frames is None else ("--seconds", f"{options.frames / fps}")
    with tempfile.TemporaryDirectory() as cache:
        _record_of(("live", folder, "--replay", "--seconds", "2"), Path(cache))  # compiles
        for _ in range(options.repeats):
            record = _record_of(("live", folder, "--replay", *seconds), Path(cache))
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
    print("to reach: median 30 ms, 99 % 45 ms, largest 120 ms, no frame lost")
    return rows, {}


def batch(folder: Path, options: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Seconds of some runs at once, and of one run."""
    from psotrack.foreground.silhouettes import compute
    from psotrack.pipeline import track_runs
    from psotrack.settings import TrackSettings
    from psotrack.support import use_device

    if options.device:
        use_device(options.device)
    recording = open_recording(folder).usable(num_frames=options.frames)
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


def _record_of(words: tuple[object, ...], cache: Path) -> dict[str, Any]:
    """The record of a command that writes tracks, run in a program of its own."""
    with tempfile.TemporaryDirectory() as out:
        tracks = Path(out) / "tracks.csv"
        command = [sys.executable, "-m", "psotrack", *map(str, words), "--out", str(tracks)]
        subprocess.run([*command, "--cache", str(cache), "--quiet"], check=True)
        return json.loads(tracks.with_suffix(".json").read_text(encoding="utf-8"))


def _codec(video: VideoInfo) -> str:
    """Name of a video's codec, four letters."""
    capture = cv2.VideoCapture(str(video.path.resolve()), cv2.CAP_FFMPEG)
    code = int(capture.get(cv2.CAP_PROP_FOURCC))
    capture.release()
    return np.array([code], "<u4").tobytes().decode(errors="replace")


if __name__ == "__main__":
    main()

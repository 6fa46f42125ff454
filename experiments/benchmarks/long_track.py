"""Memory of `psotrack track` over a long recording, stage by stage, in all of its processes together.

    python experiments/benchmarks/long_track.py --frames 100000
    python experiments/benchmarks/long_track.py --frames 20000 --scale 0.3 --folder long

A simulated flight of four drones and ten seconds, seen by eight cameras, is shown forwards, backwards, and again. The
program `ffmpeg`, which must be there, joins the videos. 100,000 frames take half an hour and 2 GB in the folder.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd
import psutil

from psotrack.datasets import open_recording
from psotrack.rig_files import write_rig
from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate
from psotrack.support import progress_bar

#: The flight, its frames, and how H.264 stores them: with little loss, and quick to decode.
_SCENARIO, _FRAMES = "S02_D4_A", 250
_H264 = ("-c:v", "libx264", "-preset", "veryfast", "-crf", "14", "-pix_fmt", "yuv420p")
#: Seconds between two looks at the memory.
_EACH_S = 1.0


def main() -> None:
    """Make the recording, track it, and print the memory."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=100_000, help="frames of each camera (default: 100000)")
    parser.add_argument(
        "--scale", type=float, default=0.15, help="size of the images, as a share of 1920 x 1080"
    )
    parser.add_argument("--folder", type=Path, help="keep recording, silhouettes and tracks here")
    given = parser.parse_args()
    if shutil.which("ffmpeg") is None:
        sys.exit("expected the program ffmpeg, found none: install FFmpeg")
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        memory = track(make_recording(folder, given.frames, given.scale), folder)
    print(f"{given.frames} frames of each camera, MB of memory in all processes:")
    print(memory.to_string())


def make_recording(folder: Path, num_frames: int, scale: float) -> Path:
    """A recording of a flight in a loop; one that is in the folder is taken as it is."""
    made = folder / f"recording_{num_frames}_{scale:g}"
    if made.exists():
        return made
    partial = made.with_name(f".{made.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    recipe = change_scenario(scenario(_SCENARIO), {"num_frames": _FRAMES})
    flight = simulate(
        recipe,
        partial / "flight",
        SimulationSettings(scale=scale, masks=False, onboard=False),
        report=progress_bar,
    )
    recording = open_recording(flight)
    write_rig(partial / "rig.toml", recording.rig)
    lines = ["version = 1", 'calibration = "rig.toml"']
    for name, video in recording.videos.items():
        _loop(video.path, partial / f"{name}.mp4", num_frames)
        lines += [f"[cameras.{name}]", f'video = "{name}.mp4"']
    (partial / "recording.toml").write_text("\n".join(lines) + "\n")
    return partial.rename(made)


def _loop(video: Path, out: Path, num_frames: int) -> None:
    """Show a video forwards, backwards, and again."""
    period = out.with_name("period.mp4")
    there_and_back = "[0:v]split[there][copy];[copy]reverse[back];[there][back]concat=n=2:v=1"
    _ffmpeg("-i", video, "-filter_complex", there_and_back, *_H264, period)
    _ffmpeg("-stream_loop", "-1", "-i", period, "-frames:v", num_frames, "-c", "copy", out)
    period.unlink()


def _ffmpeg(*arguments: object) -> None:
    subprocess.run(["ffmpeg", "-v", "error", "-y", *map(str, arguments)], check=True)


def track(recording: Path, folder: Path) -> pd.DataFrame:
    """Track the recording; the memory of all processes in each stage."""
    outputs = ["--out", folder / "tracks.parquet", "--cache", folder / "cache", "--force"]
    # Drones that fly backwards at once are lost for some frames; the number says that those that return are the same.
    command = ["track", recording, *outputs, "--drones", "4"]
    began = time.monotonic()
    said = folder / "progress.txt"
    with said.open("w") as stderr:
        process = psutil.Popen(
            [sys.executable, "-m", "psotrack", *map(str, command), "--progress", "lines"], stderr=stderr
        )
        samples = []
        while process.poll() is None:
            samples.append((_stage(said.read_text()), time.monotonic() - began, _memory_mb(process)))
            time.sleep(_EACH_S)
    if process.returncode:
        sys.exit(said.read_text())
    by_stage = pd.DataFrame(samples, columns=["stage", "at_s", "mb"]).groupby("stage", sort=False)
    # The first seconds of a stage belong to the one before: the program speaks a little later.
    return by_stage.agg(
        seconds=("at_s", lambda at_s: at_s.max() - at_s.min()),
        first_tenth=("mb", lambda mb: mb.iloc[: max(1, len(mb) // 10)].max()),
        median=("mb", "median"),
        last=("mb", "last"),
        largest=("mb", "max"),
    ).round()


def _stage(said: str) -> str:
    """The stage of which the last line of progress speaks."""
    lines = re.findall(r"^psotrack: (\w+): (\d+) of (\d+)", said, re.MULTILINE)
    if not lines:
        return "start"
    name, done, of = lines[-1]
    return f"after {name}" if done == of else name


def _memory_mb(process: psutil.Process) -> float:
    """Resident memory of a process and of its children, 10^6 bytes."""
    found = 0
    for each in [process, *process.children(recursive=True)]:
        try:
            found += each.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return found / 1e6


if __name__ == "__main__":
    main()

"""Memory of `psotrack track` over a long recording, stage by stage, in all of its processes together.

    python experiments/benchmarks/memory.py                                     # 3,000 frames of eight cameras
    python experiments/benchmarks/memory.py --frames 100000 --scale 0.15        # an hour
    python experiments/benchmarks/memory.py --frames 20000 --folder long        # keeps the recording

A simulated flight of four drones and ten seconds, seen by eight cameras, is shown forwards, backwards, and again. The
exit code is 1 if the memory exceeds the limit.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import psutil

from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import VideoInfo, VideoWriter, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate
from psotrack.support import processors, progress_bar

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

#: The flight, and the number of its frames that are shown.
_SCENARIO, _FRAMES = "S02_D4_A", 250
#: Seconds between two looks at the memory.
_EACH_S = 0.5


def main() -> None:
    """Make the recording, track it, and print the memory."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=3000, help="frames of each camera (default: 3000)")
    parser.add_argument(
        "--scale",
        type=float,
        default=0.5,
        help="size of the images, as a share of 1920 x 1080 (default: 0.5)",
    )
    parser.add_argument("--folder", type=Path, help="keep recording, silhouettes and tracks here")
    parser.add_argument("--limit-gb", type=float, default=2.0, help="largest memory, 10^9 bytes (default: 2)")
    parser.add_argument("--results", type=Path, help="write the result and its record into this folder")
    options = parser.parse_args()
    run = _results.Run("memory") if options.results else None
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        recording = make_recording(folder, options.frames, options.scale)
        num_cameras = len(open_recording(recording).rig)
        memory = track(recording, folder)
    peak_gb = float(memory["largest_mb"].max()) / 1e3
    print(
        f"{options.frames} frames of {num_cameras} cameras at {options.scale:g} of full size, all processes:"
    )
    print(memory.to_string())
    print(f"peak of the resident memory {peak_gb:.2f} GB, limit {options.limit_gb:g} GB")
    if run is not None:
        figures = {"frames": options.frames, "cameras": num_cameras, "scale": options.scale}
        figures |= {"peak_gb": peak_gb, "limit_gb": options.limit_gb}
        run.save(options.results, rows=memory.reset_index(), figures=figures)
    sys.exit(peak_gb > options.limit_gb)


def make_recording(folder: Path, num_frames: int, scale: float) -> Path:
    """A recording of a flight in a loop; one that is in the folder is taken as it is."""
    made = folder / f"recording_{num_frames}_{scale:g}"
    if made.exists():
        return made
    partial = made.with_name(f".{made.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    recipe = change_scenario(scenario(_SCENARIO), {"num_frames": min(_FRAMES, num_frames)})
    settings = SimulationSettings(scale=scale, masks=False, onboard=False)
    recording = open_recording(simulate(recipe, partial / "flight", settings, report=progress_bar))
    write_rig(partial / "rig.toml", recording.rig)
    lines = ["version = 1", 'calibration = "rig.toml"']
    for name in recording.videos:
        lines += [f"[cameras.{name}]", f'video = "{name}.avi"']
    (partial / "recording.toml").write_text("\n".join(lines) + "\n")
    with ThreadPoolExecutor(processors()) as threads:
        made_videos = [
            threads.submit(show_again, video, partial / f"{name}.avi", num_frames)
            for name, video in recording.videos.items()
        ]
        for each in made_videos:
            each.result()
    return partial.rename(made)


def show_again(video: VideoInfo, out: Path, num_frames: int) -> None:
    """Show a video forwards, backwards, and again."""
    images = list(read_frames(video))
    there_and_back = images + images[-2:0:-1]
    with VideoWriter(out, video.fps, images[0].shape[1::-1]) as writer:
        for frame in range(num_frames):
            writer.write(there_and_back[frame % len(there_and_back)])


def track(recording: Path, folder: Path) -> pd.DataFrame:
    """Track the recording; the memory of all processes in each stage."""
    outputs = ["--out", folder / "tracks.parquet", "--cache", folder / "cache", "--force"]
    # Drones that fly backwards at once are lost for some frames; the number says that those that return are the same.
    command = ["track", recording, *outputs, "--drones", "4", "--progress", "lines"]
    began = time.monotonic()
    said = folder / "progress.txt"
    with said.open("w") as stderr:
        process = psutil.Popen([sys.executable, "-m", "psotrack", *map(str, command)], stderr=stderr)
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
        first_tenth_mb=("mb", lambda mb: mb.iloc[: max(1, len(mb) // 10)].max()),
        median_mb=("mb", "median"),
        last_mb=("mb", "last"),
        largest_mb=("mb", "max"),
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

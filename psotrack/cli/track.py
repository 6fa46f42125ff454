"""`psotrack track`: drones from the videos of a sequence, or from detections in them."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click
from msgspec import Meta

from psotrack.cli.archived import chosen_extent, with_comparison
from psotrack.cli.options import (
    DETECTOR_SIZE,
    SEQUENCE,
    Extent,
    beside,
    compiled_folder,
    detections_of,
    extent_options,
    out_option,
    recording_named,
    running,
)
from psotrack.cli.output import Output, check_suffix, write_json
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.cli.settings import chosen_settings, config_options, settings_options
from psotrack.errors import SettingsError
from psotrack.settings import TrackSettings

if TYPE_CHECKING:
    from psotrack.recordings import Recording


@dataclass(frozen=True)
class TrackOptions:
    """How a recording is tracked, apart from the settings.

    Attributes:
        detector: detector, instead of --detections: a YOLO network (v5 to v11) that was trained on drones, or a
            detector NAME that an installed package adds. Its detections are stored.
        detector_size: side of the network's square input, in pixels.
        causal: track as if the cameras were live: no frame uses a later one, and a drone's rows begin when it is found.
        most_drones: largest number of drones at one time with --causal.
    """

    detector: Annotated[str, Meta(extra={"metavar": "MODEL.onnx|NAME"})] | None = None
    detector_size: int = DETECTOR_SIZE
    causal: bool = False
    most_drones: Annotated[int, Meta(ge=1, le=1000)] = 16


@dataclass(frozen=True)
class _Run:
    """A run of `track`: a recording and its path, settings, the file of the tracks, the seconds before the work."""

    sequence: Path
    recording: Recording
    settings: TrackSettings
    out: Path
    extent: Extent
    start_s: float


@click.command(cls=HelpfulCommand)
@SEQUENCE
@out_option("File of the tracks; it ends in .csv or .parquet.  [default: SEQ/results/tracks.csv]")
@settings_options(
    "method",
    "detections",
    "drones.count",
    "drones.size_m",
    "clocks",
    "smooth",
    "swarm.particles",
    "swarm.iterations",
    "seed",
)
@options_of(TrackOptions, "how", rare=("detector_size", "most_drones"))
@extent_options
@config_options
@running()
def track(
    output: Output,
    sequence: Path,
    out: Path | None,
    settings: dict[str, Any],
    how: TrackOptions,
    extent: Extent,
) -> None:
    """Track the drones of SEQ from its videos, or from detections in them.

    Writes OUT, with one row per frame and drone, and two files beside OUT. The file that ends in .json contains all
    settings, the estimates for each drone, births of tracks, encounters of drones, versions, device, input keys and
    seconds per stage. The file that ends in .ambiguity.csv says for each frame which drones may be confused.

    SEQ may be an archive of `psotrack archive`. Settings that are not given are then those of the archive's tracks, and
    a line says whether the tracks are the same, or from which frame on and by how much they differ.

    \b
    Examples:
      psotrack track my_lab
      psotrack track data/Simulated_Data/S02_D4_A --out tracks.csv --smooth
      psotrack track flight.psotrack --out again.csv
      psotrack track my_lab --method projection-lines --detections blobs
      psotrack track my_lab --method fused --detector drones.onnx
      psotrack track my_lab --set swarm.kind=joint --particles 100 --iterations 70 --save-config paper.toml
      psotrack track my_lab --config paper.toml --out again.csv
    """
    from psotrack.foreground.detection import DetectorSettings, find_detector
    from psotrack.pipeline import (
        Parts,
        check_detections,
        track_recording,
        usable_for,
        with_real_time,
    )
    from psotrack.recordings.datasets import open_recording
    from psotrack.show.flights import write_tracked
    from psotrack.support import keep_compiled

    detector = how.detector
    out = out or beside(sequence, "tracks.csv")
    check_suffix("--out", out, ".csv", ".parquet")
    record_path, ambiguity_path = out.with_suffix(".json"), out.with_suffix(".ambiguity.csv")
    output.refuse(out, record_path, *([] if how.causal else [ambiguity_path]))
    chosen = chosen_settings(settings)
    num_frames, causal, most_drones = chosen_extent(extent.num_frames, how.causal, how.most_drones)
    parts = Parts()
    if detector is not None:
        if causal:
            raise SettingsError("--detector", expected="none with --causal", found=detector)
        parts["detector"] = find_detector(detector, DetectorSettings(size=how.detector_size))
    keep_compiled(compiled_folder(extent.cache))
    start_s = time.perf_counter() - output.started_s
    opened = open_recording(sequence)
    if detector is None:
        if chosen.reads_detections and "detections" not in settings:
            chosen = chosen.changed({"detections": detections_of(output, opened)})
        check_detections(opened, chosen)
    recording = usable_for(
        opened, chosen, cameras=extent.cameras, num_frames=num_frames, videos=detector is not None
    )
    if causal:
        _track_causally(output, _Run(sequence, recording, chosen, out, extent, start_s), most_drones)
        return
    tracked = track_recording(
        recording, chosen, cache=extent.silhouettes, jobs=extent.jobs, report=output.report, **parts
    )
    tracks = tracked.trajectories
    record = with_real_time(tracked.record, time.perf_counter() - output.started_s, start_s=start_s)
    record = {**record, "recording": recording_named(sequence, out)}
    write_tracked(out, replace(tracked, record=record), force=output.force)
    record, sentence = with_comparison(record, out, chosen)
    if sentence:
        write_json(record_path, record)
    output.json(record)
    seen = f"{tracks.num_drones} drones, {tracks.num_frames} frames, {tracks.seen.mean():.1%} seen"
    output.say(f"{out}: {seen}, {_speed(record)}{sentence}")
    output.drones(tracks, tracked.size_m)
    for name, clock in record.get("camera_clocks", {}).items():
        std = "" if clock["offset_std_s"] is None else f" ± {1e3 * clock['offset_std_s']:.1f}"
        output.say(f"clock of camera {name}: corrected by {1e3 * clock['offset_s']:+.1f}{std} ms")


def _speed(record: dict[str, Any]) -> str:
    """How long the work took, and how that compares with the time that was filmed."""
    from psotrack.pipeline import speed_in_words

    return f"{record['seconds']['total']:.1f} s, {speed_in_words(record['real_time_factor'])}"


def _track_causally(output: Output, run: _Run, most_drones: int) -> None:
    """Track a recording without the future, and write the rows of each frame as it is done."""
    from psotrack.pipeline import track_causally, with_real_time
    from psotrack.trajectories import RowStream, read_trajectories

    frames, record = track_causally(
        run.recording,
        run.settings,
        cache=run.extent.silhouettes,
        jobs=run.extent.jobs,
        most_drones=most_drones,
        report=output.report,
    )
    record_path = run.out.with_suffix(".json")
    with RowStream(run.out, force=output.force, record=record_path) as rows:
        for frame in frames:
            rows.write(frame)
    record = with_real_time(record, time.perf_counter() - output.started_s, start_s=run.start_s)
    record = {**record, "recording": recording_named(run.sequence, run.out)}
    record, sentence = with_comparison(record, run.out, run.settings)
    write_json(record_path, record)
    output.json(record)
    output.say(f"{run.out}: {record['drones']} drones, {record['frames']} frames, {_speed(record)}{sentence}")
    # A file without rows is none of tracks.
    if record["drones"] and output.shows:
        output.drones(read_trajectories(run.out))

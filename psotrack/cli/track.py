"""`psotrack track`: drones from the videos of a sequence, or from detections in them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from psotrack.cli.archived import chosen_extent, chosen_settings, with_comparison
from psotrack.cli.options import (
    CACHE,
    CAMERAS,
    DETECTOR_SIZE,
    FORCE,
    ITERATIONS,
    JOBS,
    JSON,
    MOST_DRONES,
    PARTICLES,
    SEQUENCE,
    TRACK,
    Numbers,
    cache_folder,
    camera_names,
    compiled_folder,
    frames_option,
    reporting,
    silhouette_options,
)
from psotrack.cli.output import output_json, print_drones, print_line, report_to, write_json
from psotrack.cli.run_files import FileOr, run_file_options
from psotrack.errors import SettingsError
from psotrack.settings import USUAL_SPEED_M_S, Clocks, SwarmKind, TrackSettings
from psotrack.support import atomic_write_all, refuse_files

if TYPE_CHECKING:
    from psotrack.recordings import Recording


@click.command()
@SEQUENCE
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="File of the tracks; it ends in .csv or .parquet.",
)
@click.option(
    "--method",
    default=TRACK.method,
    show_default=True,
    metavar="swarm|projection-lines|fused|NAME",
    help="swarm searches in silhouettes; projection-lines triangulates detections; fused combines both, weighted by "
    "their covariances; NAME is a method that an installed package adds.",
)
@click.option(
    "--detections",
    type=FileOr("yolo", "blobs"),
    default=TRACK.detections,
    show_default=True,
    metavar="yolo|blobs|FOLDER",
    help="Detections for projection-lines and fused: SEQ's own, blobs of its silhouettes, or a folder with a CSV file "
    "per camera.",
)
@click.option(
    "--detector",
    type=FileOr(suffix=".onnx"),
    metavar="MODEL.onnx|NAME",
    help="Detector, instead of --detections: a YOLO network (v5 to v11) that was trained on drones, or a detector NAME "
    "that an installed package adds. Its detections are stored.",
)
@click.option(
    "--detector-size",
    type=int,
    default=DETECTOR_SIZE,
    show_default=True,
    help="Side of the network's square input, in pixels.",
)
@PARTICLES
@ITERATIONS
@click.option(
    "--swarm",
    type=click.Choice(get_args(SwarmKind)),
    default=TRACK.swarm.kind,
    show_default=True,
    help="joint: one swarm over all drones, as in the paper; per-drone: one swarm for each drone.",
)
@click.option(
    "--score",
    default=TRACK.score.kind,
    show_default=True,
    metavar="soft|hard|NAME",
    help="Score of positions: soft uses concentric windows; hard is the paper's one box in whole pixels; NAME is a "
    "score that an installed package adds.",
)
@click.option(
    "--search",
    default=TRACK.swarm.search,
    show_default=True,
    metavar="pso|pso-kernel|NAME",
    help="Search for the best positions: pso is particle swarm optimisation; pso-kernel is the same as one kernel per "
    "frame, for a GPU (unproven: no GPU has run it yet; slow on a CPU); NAME is a search that an installed package "
    "adds.",
)
@click.option(
    "--seed", type=int, default=TRACK.seed, show_default=True, help="Seed of the swarm's random numbers."
)
@click.option(
    "--init",
    type=FileOr("auto", "truth"),
    default=TRACK.init,
    show_default=True,
    metavar="auto|truth|FILE",
    help="Initial positions of the drones: auto finds them in the first frames; truth takes them from the reference; "
    "FILE is a file of tracks.",
)
@click.option(
    "--drones", type=int, metavar="N", help="Number of drones.  [default: the number that --init finds]"
)
@click.option(
    "--drone-size",
    "drone_size_m",
    type=Numbers(3),
    metavar="X,Y,Z",
    help="Full lengths of a drone along x, y and z, in metres.  [default: estimated while tracking]",
)
@click.option(
    "--body-offset",
    "body_offset_m",
    type=Numbers(3),
    default=TRACK.drones.body_offset_m,
    metavar="X,Y,Z",
    help="Vector from the origin of a drone's body to the middle of its silhouette (with projection-lines: box), "
    "along the world's axes, in metres.  [default: 0,0,0]",
)
@click.option(
    "--bounds",
    "bounds_m",
    type=Numbers(6),
    metavar="X0,X1,Y0,Y1,Z0,Z1",
    help="Bounds of the room, in metres.  [default: derived from the cameras and from what moves]",
)
@click.option(
    "--max-speed",
    "max_speed_m_s",
    type=float,
    help=f"Largest speed of a drone, in m/s.  [default: {USUAL_SPEED_M_S:g}, or more where the data show more]",
)
@click.option(
    "--min-cameras",
    "min_cameras_to_begin",
    type=int,
    metavar="N",
    help="Number of cameras, at different places, that must agree to begin a track; two keep it.  [default: 3 where at "
    "least 3 cameras have the place in view, else 2]",
)
@click.option(
    "--rate",
    "rate_hz",
    type=float,
    metavar="HZ",
    help="Instants per second at which drones are tracked.  [default: the rate of the fastest camera]",
)
@click.option(
    "--clocks",
    type=click.Choice(get_args(Clocks)),
    default=TRACK.clocks,
    show_default=True,
    help="Times of the cameras' frames. given: those of SEQ; auto: corrected by each camera's offset and drift, which "
    "are estimated from the motion of the drones, before a second pass.",
)
@click.option(
    "--rig-error",
    "rig_deg",
    type=float,
    default=TRACK.errors.rig_deg,
    metavar="DEGREES",
    help="Angle by which each camera may be turned: part of the covariances, also where the cameras do not show it.  "
    "[default: as much as they show]",
)
@click.option(
    "--pixel-error",
    "pixel_px",
    type=float,
    default=TRACK.errors.pixel_px,
    metavar="PX",
    help="Lasting error of a drone's place in an image along either axis, in pixels: part of the covariances, also "
    "where the cameras do not show it.  [default: as much as they show]",
)
@click.option(
    "--smooth", is_flag=True, default=TRACK.smooth, help="Correct each frame's positions by later frames."
)
@click.option(
    "--causal",
    is_flag=True,
    help="Track as if the cameras were live: no frame uses a later one, and a drone's rows begin when it is found.",
)
@MOST_DRONES
@silhouette_options
@CAMERAS
@frames_option
@CACHE
@JOBS
@FORCE
@run_file_options
@reporting
@JSON
def track(
    sequence: Path,
    out: Path,
    cameras: str | None,
    num_frames: int | None,
    cache: Path | None,
    jobs: int | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
    detector: str | None,
    detector_size: int,
    causal: bool,
    most_drones: int,
    **settings: Any,
) -> None:
    """Track the drones of SEQ from its videos, or from detections in them.

    Writes OUT, with one row per frame and drone, and two files beside OUT. The file that ends in .json contains all
    settings, the estimates for each drone, births of tracks, encounters of drones, versions, device, input keys and
    seconds per stage. The file that ends in .ambiguity.csv says for each frame which drones may be confused.

    SEQ may be an archive of `pack`. Options that are not given are then those of the archive's tracks, and a line says
    whether the tracks are the same, or from which frame on and by how much they differ.

    \b
    Examples:
      psotrack track data/Simulated_Data/S02_D4_A --out tracks.csv
      psotrack track flight/recording.toml --out tracks.csv
      psotrack track flight.psotrack --out again.csv
      psotrack track data/Simulated_Data/S02_D4_A --out smooth.csv --smooth
      psotrack track data/Simulated_Data/S02_D4_A --out as_live.csv --causal
      psotrack track data/Simulated_Data/S02_D4_A --out lines.csv --method projection-lines
      psotrack track data/Real_Data/R12_D4 --out both.csv --method fused --detector drones.onnx --detector-size 1280
      psotrack track data/Simulated_Data/S02_D4_A --out fast.csv --particles 15 --save-config fast.toml
      psotrack track --config fast.toml --out again.csv
      psotrack track data/Simulated_Data/S02_D4_A --out paper.parquet --swarm joint --particles 100 --iterations 70
    """
    started = click.get_current_context().obj or time.perf_counter()
    from psotrack.foreground.detection import DetectorSettings, find_detector
    from psotrack.pipeline import (
        Parts,
        check_detections,
        speed_in_words,
        track_recording,
        usable_for,
        with_real_time,
    )
    from psotrack.recordings.datasets import open_recording
    from psotrack.support import keep_compiled
    from psotrack.trajectories import write_ambiguity, write_trajectories

    if out.suffix not in {".csv", ".parquet"}:
        raise SettingsError("--out", expected="a file that ends in .csv or .parquet", found=out.name)
    record_path, ambiguity_path = out.with_suffix(".json"), out.with_suffix(".ambiguity.csv")
    refuse_files(out, record_path, *([] if causal else [ambiguity_path]), force=force)
    chosen = chosen_settings(settings)
    num_frames, causal, most_drones = chosen_extent(num_frames, causal, most_drones)
    parts = Parts()
    if detector is not None:
        parts["detector"] = find_detector(detector, DetectorSettings(size=detector_size))
    keep_compiled(compiled_folder(cache))
    start_s = time.perf_counter() - started
    opened = open_recording(sequence)
    if detector is None:
        check_detections(opened, chosen)
    recording = usable_for(
        opened,
        chosen,
        cameras=camera_names(cameras),
        num_frames=num_frames,
        videos=detector is not None,
    )
    if causal:
        if detector is not None:
            raise SettingsError("--detector", expected="none with --causal", found=detector)
        _track_causally(recording, chosen, out, cache, jobs, most_drones, force, quiet, json_path, started)
        return
    tracked = track_recording(
        recording,
        chosen,
        cache=cache_folder(cache),
        jobs=jobs,
        report=report_to(quiet),
        **parts,
    )
    identities, time_s = tracked.identities, tracked.trajectories.time_s
    record = with_real_time(tracked.record, time.perf_counter() - started, start_s=start_s)
    with atomic_write_all(record_path, ambiguity_path, out) as (record_file, ambiguity_file, tracks_file):
        write_trajectories(tracks_file, tracked.trajectories)
        write_ambiguity(ambiguity_file, time_s, identities.pairs, identities.ambiguity)
        record, sentence = with_comparison(record, tracks_file, chosen)
        write_json(record_file, record)
    output_json(json_path, record, force)
    seen = tracked.trajectories.seen.mean()
    print_line(
        quiet,
        json_path,
        f"{out}: {tracked.trajectories.num_drones} drones, {tracked.trajectories.num_frames} frames, "
        f"{seen:.1%} seen, {record['seconds']['total']:.1f} s, {speed_in_words(record['real_time_factor'])}{sentence}",
    )
    print_drones(quiet, json_path, tracked.trajectories, tracked.size_m)


def _track_causally(
    recording: Recording,
    settings: TrackSettings,
    out: Path,
    cache: Path | None,
    jobs: int | None,
    most_drones: int,
    force: bool,
    quiet: bool,
    json_path: Path | None,
    started: float,
) -> None:
    """Track a recording without the future, and write the rows of each frame as it is done."""
    from psotrack.pipeline import speed_in_words, track_causally, with_real_time
    from psotrack.trajectories import RowStream, read_trajectories

    start_s = time.perf_counter() - started
    frames, record = track_causally(
        recording,
        settings,
        cache=cache_folder(cache),
        jobs=jobs,
        most_drones=most_drones,
        report=report_to(quiet),
    )
    with RowStream(out, force=force, record=out.with_suffix(".json")) as rows:
        for frame in frames:
            rows.write(frame)
    record = with_real_time(record, time.perf_counter() - started, start_s=start_s)
    record, sentence = with_comparison(record, out, settings)
    write_json(out.with_suffix(".json"), record)
    output_json(json_path, record, force)
    print_line(
        quiet,
        json_path,
        f"{out}: {record['drones']} drones, {record['frames']} frames, {record['seconds']['total']:.1f} s, "
        f"{speed_in_words(record['real_time_factor'])}{sentence}",
    )
    # A file without rows is none of tracks.
    if record["drones"] and not quiet:
        print_drones(quiet, json_path, read_trajectories(out))

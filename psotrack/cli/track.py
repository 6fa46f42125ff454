"""`psotrack track`: drones from the videos of a sequence, or from detections in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from psotrack import support, trajectories
from psotrack.cli.commands import command
from psotrack.cli.options import (
    DETECTOR_SIZE,
    Extent,
    MostDrones,
    Seq,
    beside,
    compiled_folder,
    detections_of,
    recording_named,
)
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.settings import TrackingSettings, chosen_extent, chosen_settings, with_comparison
from psotrack.cli.types import says
from psotrack.errors import SettingsError
from psotrack.foreground import detection
from psotrack.foreground.detection import Layout
from psotrack.recordings import datasets
from psotrack.show import flights
from psotrack.support import write_json


@command()
def track(
    output: Output,
    sequence: Seq,
    *,
    out: Path | None = None,
    settings: Annotated[
        dict[str, Any],
        TrackingSettings(
            usual=(
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
        ),
    ],
    detector: Annotated[str | None, says(metavar="network|FILE|NAME")] = None,
    detector_size: Annotated[int, says(rare=True)] = DETECTOR_SIZE,
    detector_layout: Annotated[Layout | None, says(rare=True)] = None,
    causal: bool = False,
    most_drones: MostDrones = 16,
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
      psotrack track my_lab --background network
      psotrack track my_lab --method fused --detector drones.onnx
      psotrack track my_lab --swarm joint --particles 100 --iterations 70 --save-config paper.toml
      psotrack track my_lab --config paper.toml --out again.csv

    Options:
        out: file of the tracks; it ends in .csv or .parquet. None: SEQ/results/tracks.csv.
        detector: detector, instead of --detections: "network", the network that comes with the package; a file of
            `psotrack train`; a YOLO network (v5 to v11) that was trained on drones; or a detector NAME that an
            installed package adds. Its detections are stored.
        detector_size: side of the network's square input, in pixels.
        detector_layout: layout of the network's output, as `psotrack detect --layout`. None: told by the output.
        causal: track as if the cameras were live: no frame uses a later one, and a drone's rows begin when it is found.
        most_drones: largest number of drones at one time with --causal.
    """
    # While this process imports what it needs, which takes a second, another one gets ready to make silhouettes.
    support.start_server("psotrack.foreground.silhouettes.store")
    from psotrack import pipeline

    out = out or beside(sequence, "tracks.csv")
    # Rows that come one by one are those of a CSV file.
    check_suffix("--out", out, ".csv", *([] if causal else [".parquet"]))
    record_path, ambiguity_path = out.with_suffix(".json"), out.with_suffix(".ambiguity.csv")
    output.refuse(out, record_path, *([] if causal else [ambiguity_path]))
    chosen = chosen_settings(settings)
    num_frames, causal, most_drones = chosen_extent(extent.num_frames, causal, most_drones)
    parts = pipeline.Parts()
    if detector is not None:
        if causal:
            raise SettingsError("--detector", expected="none with --causal", found=detector)
        network = detection.DetectorSettings(size=detector_size, layout=detector_layout)
        parts["detector"] = detection.find_detector(detector, network)
    support.keep_compiled(compiled_folder(extent.cache))
    start_s = output.elapsed_s
    opened = datasets.open_recording(sequence)
    if detector is None:
        if chosen.reads_detections and "detections" not in settings:
            chosen = chosen.changed({"detections": detections_of(output, opened)})
        pipeline.check_detections(opened, chosen)
    recording = pipeline.usable_for(
        opened, chosen, cameras=extent.cameras, num_frames=num_frames, videos=detector is not None
    )
    made: dict[str, Any] = {"cache": extent.silhouettes, "jobs": extent.jobs, "report": output.report}

    def recorded(record: Mapping[str, Any]) -> dict[str, Any]:
        timed = pipeline.with_real_time(record, output.elapsed_s, start_s=start_s)
        return {**timed, "recording": recording_named(sequence, out)}

    if causal:
        frames, record = pipeline.track_causally(recording, chosen, most_drones=most_drones, **made)
        with trajectories.RowStream(out, force=output.force, record=record_path) as rows:
            for frame in frames:
                rows.write(frame)
        record, sentence = with_comparison(recorded(record), out, chosen)
        write_json(record_path, record)
        size_m, seen = None, f"{record['drones']} drones, {record['frames']} frames"
        # A file without rows is none of tracks.
        tracks = trajectories.read_trajectories(out) if record["drones"] and output.shows else None
    else:
        tracked = pipeline.track_recording(recording, chosen, **made, **parts)
        tracked = replace(tracked, record=recorded(tracked.record))
        flights.write_tracked(out, tracked, force=output.force)
        record, sentence = with_comparison(dict(tracked.record), out, chosen)
        if sentence:
            write_json(record_path, record)
        tracks, size_m = tracked.trajectories, tracked.size_m
        seen = f"{tracks.num_drones} drones, {tracks.num_frames} frames, {tracks.seen.mean():.1%} seen"
    output.json(record)
    speed = pipeline.speed_in_words(record["real_time_factor"])
    output.say(f"{out}: {seen}, {record['seconds']['total']:.1f} s, {speed}{sentence}")
    if tracks is not None:
        output.drones(tracks, size_m)
    for name, clock in record.get("camera_clocks", {}).items():
        std = "" if clock["offset_std_s"] is None else f" ± {1e3 * clock['offset_std_s']:.1f}"
        output.say(f"clock of camera {name}: corrected by {1e3 * clock['offset_s']:+.1f}{std} ms")
        for lost in clock.get("lost_frames", []):
            loss = "1 frame is" if lost["count"] == 1 else f"{lost['count']} frames are"
            output.say(
                f"clock of camera {name}: {loss} lost before frame {lost['before_frame']}, and accounted for"
            )

"""The record of a run, the JSON file beside its tracks, and what a whole run gave: the parts that people look at."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from psotrack.calibration.clocks import reference_for
from psotrack.evaluation import Evaluation, evaluate
from psotrack.pipeline import TrackedRecording, speed_in_words
from psotrack.recordings.datasets import open_recording
from psotrack.recordings.exchange import read_tracks
from psotrack.support import (
    atomic_write_all,
    convert,
    html_block,
    html_lines,
    read_json,
    refuse_files,
    write_json,
)
from psotrack.trajectories import Trajectories, write_ambiguity, write_trajectories


class LearnedDrone(msgspec.Struct, frozen=True):
    """What a run learned of one drone.

    Attributes:
        drone: number of the drone.
        size_m: full lengths along the world's axes, metres.
    """

    drone: int
    size_m: tuple[float, float, float]


class MeetingRecord(msgspec.Struct, frozen=True):
    """Two drones that met: see `identity.Encounter`."""

    drones: tuple[int, int]
    closest_frame: int
    distance_m: float
    outcome: str


class RunRecord(msgspec.Struct, frozen=True):
    """The record of `track`, `live` or another command that writes tracks; a part that it lacks has its default.

    Attributes:
        sequence: name of the recording; empty if unknown.
        recording: path of the recording, relative to the record's folder or absolute; empty if unknown.
        rate_hz: instants per second.
        drones: what was learned of each drone; their number alone, where nothing was learned.
        encounters: drones that met.
        left_out: by camera, intervals of frames in which the camera counts as seeing nothing.
        camera_errors: what the cameras show of their errors.
        knocks: cameras that were knocked in mid-flight.
        explained: share of the detections that tracks explain, of all cameras and of each.
        settings: settings of the run.
        versions: versions of the packages.
        device: the device that computed.
        real_time_factor: seconds of video per second of wall clock.
        whole: the whole record, as plain data.
    """

    sequence: str = ""
    recording: str = ""
    rate_hz: float | None = None
    drones: int | tuple[LearnedDrone, ...] = ()
    encounters: tuple[MeetingRecord, ...] = ()
    left_out: dict[str, list[tuple[int, int]]] = {}
    camera_errors: dict[str, Any] = {}
    knocks: tuple[dict[str, Any], ...] = ()
    explained: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    versions: dict[str, str] = {}
    device: dict[str, str] = {}
    real_time_factor: float | None = None
    whole: dict[str, Any] = {}


def recording_beside(recording: Path | str, tracks: Path | str) -> str:
    """Path of a recording as the record of its tracks holds it, under the key `recording`.

    It is relative where the recording lies in the folder of the tracks, or the tracks in the recording's, so that both
    can be moved together, and else absolute.

    Args:
        recording: the recording, as a user names it for `open_recording`.
        tracks: file of the tracks, beside which the record is.
    """
    path, folder = Path(recording).absolute(), Path(tracks).absolute().parent
    together = path.is_relative_to(folder) or folder.is_relative_to(path if path.is_dir() else path.parent)
    return Path(os.path.relpath(path, folder)).as_posix() if together else str(path)


def record_files(tracks: Path) -> tuple[Path, Path]:
    """Paths of the record of a run, and of which drones may be confused, beside a file of tracks."""
    return tracks.with_suffix(".json"), tracks.with_suffix(".ambiguity.csv")


def write_tracked(
    path: Path | str, tracked: TrackedRecording, recording: Path | str | None = None, *, force: bool = False
) -> None:
    """Write tracks, and beside them their record (.json) and which drones may be confused (.ambiguity.csv).

    Args:
        path: file of the tracks; it ends in .csv or .parquet.
        tracked: result of the run.
        recording: the recording, as a user names it for `open_recording`; the record names it. None: it names none.
        force: replace existing files.

    Raises:
        OutputError: a file exists and `force` is not set, or it cannot be written.
    """
    path = Path(path)
    files = *record_files(path), path
    refuse_files(*files, force=force)
    named = {} if recording is None else {"recording": recording_beside(recording, path)}
    tracks, identities = tracked.trajectories, tracked.identities
    with atomic_write_all(*files) as (record_file, ambiguity_file, tracks_file):
        write_trajectories(tracks_file, tracks)
        write_ambiguity(ambiguity_file, tracks.time_s, identities.pairs, identities.ambiguity)
        write_json(record_file, {**tracked.record, **named})


def read_run_record(path: Path | str) -> RunRecord | None:
    """Read the record of a run; None for JSON that says of itself that it has another format, such as exported tracks.

    Raises:
        InputError: the file cannot be read, or is no record of a run.
    """
    path = Path(path)
    content = read_json(path, "the record of a run, as `psotrack track` writes it")
    return None if "format" in content else as_run_record(content, path)


def as_run_record(content: dict[str, Any], where: object) -> RunRecord:
    """The record of a run of plain data.

    Args:
        content: the data.
        where: where they come from, for messages.

    Raises:
        InputError: a part is wrong.
    """
    return convert({**content, "whole": content}, RunRecord, f"{where}, ")


@dataclass(frozen=True, repr=False)
class RunSummary:
    """What `psotrack run` gave; its text is what the command prints at the end.

    Attributes:
        name: name of the recording.
        results: folder of the results: `tracks.csv`, `report.html`, `doctor.json`, and `overlay` with the videos.
        trajectories: the tracks.
        record: the record of the run, as `track` writes it; empty where its file is gone.
        findings: what the doctor found, a sentence each.
        evaluation: errors; None where the recording has no reference.
    """

    name: str
    results: Path
    trajectories: Trajectories
    record: Mapping[str, Any]
    findings: tuple[str, ...]
    evaluation: Evaluation | None

    def to_dict(self) -> dict[str, Any]:
        """The numbers and the paths."""
        tracks, evaluation = self.trajectories, self.evaluation
        return {
            "recording": self.name,
            "drones": tracks.num_drones,
            "frames": tracks.num_frames,
            "seen": float(tracks.seen.mean()),
            "seconds": self.record.get("seconds", {}).get("total"),
            "real_time_factor": self.record.get("real_time_factor"),
            "camera_clocks": dict(self.record.get("camera_clocks", {})),
            "findings": list(self.findings),
            "mean_error_m": None if evaluation is None else evaluation.mean_error_m,
            "missed_rate": None if evaluation is None else evaluation.missed_rate,
            "tracks": str(self.results / "tracks.csv"),
            "report": str(self.results / "report.html"),
            "videos": str(self.results / "overlay"),
        }

    def __str__(self) -> str:
        lines = self._lines()
        width = max(map(len, lines))
        return "\n".join([self.name, *(f"  {label:<{width}}  {words}" for label, words in lines.items())])

    def __repr__(self) -> str:
        return f"RunSummary({self.name}: {self.trajectories.num_drones} drones; {self.results})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the same as a table."""
        return html_block(self.name, html_lines(self._lines()))

    def _lines(self) -> dict[str, str]:
        told, tracks = self.to_dict(), self.trajectories
        filmed_s = float(np.ptp(tracks.time_s))
        factor = told["real_time_factor"]
        speed = "" if not factor else f", {speed_in_words(factor)}"
        clocks = [f"{name} {1e3 * each['offset_s']:+.0f} ms" for name, each in told["camera_clocks"].items()]
        lines = {
            "drones": f"{tracks.num_drones}",
            "frames": f"{tracks.num_frames}, in {filmed_s:.1f} s; drones are seen in {told['seen']:.1%}",
            "tracked in": "not recorded" if told["seconds"] is None else f"{told['seconds']:.1f} s{speed}",
            "clocks": ", ".join(clocks) or "not corrected",
            "doctor": "; ".join(self.findings) or "nothing disagrees",
        }
        if self.evaluation is not None:
            lines["errors"] = f"{self.evaluation!r}".removeprefix("Evaluation(").removesuffix(")")
        return lines | {key: told[key] for key in ("tracks", "videos", "report")}


def run_summary(folder: Path | str) -> RunSummary:
    """What a whole run gave.

    Args:
        folder: folder of the recording, with its results.

    Raises:
        InputError: a file is missing, or cannot be read.
    """
    results, recording = Path(folder) / "results", open_recording(folder)
    path = results / "tracks.csv"
    tracks, record = read_tracks(path, recording=recording), read_run_record(path.with_suffix(".json"))
    found = read_json(results / "doctor.json").get("findings", [])
    evaluation = None
    if recording.truth is not None:
        evaluation = evaluate(tracks, reference_for(recording, tracks)[0])
    return RunSummary(
        recording.name,
        results,
        tracks,
        {} if record is None else record.whole,
        tuple(f"{each['message']}; {each['remedy']}" for each in found),
        evaluation,
    )

"""The record of a run, the JSON file beside its tracks: the parts of it that people look at."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from psotrack.errors import InputError
from psotrack.pipeline import TrackedRecording
from psotrack.support import atomic_write_all, convert, read_json, refuse_files, write_json
from psotrack.trajectories import write_ambiguity, write_trajectories


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

    def wrong(field: str, expected: str, found: str, remedy: str) -> InputError:
        return InputError(f"{where}, {field}", expected=expected, found=found, remedy=remedy)

    return convert({**content, "whole": content}, RunRecord, wrong)

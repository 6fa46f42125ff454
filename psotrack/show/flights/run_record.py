"""The record of a run, the JSON file beside its tracks: the parts of it that people look at."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from psotrack.errors import InputError
from psotrack.support import convert, read_json


class LearnedDrone(msgspec.Struct, frozen=True):
    """What a run learned of one drone.

    Attributes:
        drone: number of the drone.
        size_m: full lengths along the world's axes, metres.
        size_std_m: standard errors of the lengths, metres; None where they are not known.
    """

    drone: int
    size_m: tuple[float, float, float]
    size_std_m: tuple[float | None, float | None, float | None] = (None, None, None)


class MeetingRecord(msgspec.Struct, frozen=True):
    """Two drones that met: see `identity.Encounter`."""

    drones: tuple[int, int]
    first_frame: int
    closest_frame: int
    distance_m: float
    last_frame: int
    outcome: str


class RunRecord(msgspec.Struct, frozen=True):
    """The record of `track`, `live` or another command that writes tracks; a part that it lacks has its default.

    Attributes:
        sequence: name of the recording; empty if unknown.
        rate_hz: instants per second.
        drones: what was learned of each drone; their number alone, where nothing was learned.
        encounters: drones that met.
        left_out: by camera, intervals of frames in which the camera counts as seeing nothing.
        camera_errors: what the cameras show of their errors.
        settings: settings of the run.
        versions: versions of the packages.
        device: the device that computed.
        seconds: seconds per stage.
        real_time_factor: seconds of video per second of wall clock.
        whole: the whole record, as plain data.
    """

    sequence: str = ""
    rate_hz: float | None = None
    drones: int | tuple[LearnedDrone, ...] = ()
    encounters: tuple[MeetingRecord, ...] = ()
    left_out: dict[str, list[tuple[int, int]]] = {}
    camera_errors: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    versions: dict[str, str] = {}
    device: dict[str, str] = {}
    seconds: dict[str, float] = {}
    real_time_factor: float | None = None
    whole: dict[str, Any] = {}


def read_run_record(path: Path | str) -> RunRecord | None:
    """Read the record of a run; None for JSON that says of itself that it has another format, such as exported tracks.

    Raises:
        InputError: the file cannot be read, or is no record of a run.
    """
    path = Path(path)
    content = read_json(path, "the record of a run, as `psotrack track` writes it")
    if "format" in content:
        return None

    def wrong(field: str, expected: str, found: str, remedy: str) -> InputError:
        return InputError(f"{path}, {field}", expected=expected, found=found, remedy=remedy)

    return convert({**content, "whole": content}, RunRecord, wrong)

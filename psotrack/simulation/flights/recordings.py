"""Recorded flights, from motion capture, a simulator or `psotrack fly`: reading, writing and replaying."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation, RotationSpline

from psotrack.errors import InputError, SettingsError
from psotrack.recordings.datasets import read_poses, unit_quaternion
from psotrack.simulation.flights.motion import Flight, Heading
from psotrack.simulation.flights.resampling import MIN_SAMPLES, spline
from psotrack.simulation.scenarios import FlightFromFile
from psotrack.support import Table, first_repeat, read_rows, read_table, write_rows

#: Largest time before the first and after the last sample that a flight is extrapolated to. It is longer than half an
#: exposure, because the exposures of the first and last frame reach beyond the samples.
_BEYOND_S = 0.1
#: Tolerance for times of frames and times of samples, which come from different divisions.
_ROUNDING_S = 1e-6

_POSITION = ("x_m", "y_m", "z_m")
_QUATERNION = ("qw", "qx", "qy", "qz")
_POSE_FILE = re.compile(r".*_pos_(?P<rate_hz>\d+(\.\d+)?)\.csv", re.IGNORECASE)

Times = Float[np.ndarray, "times"]
Vectors = Float[np.ndarray, "times 3"]


@dataclass(frozen=True)
class Recorded:
    """Samples of a flight.

    Attributes:
        time_s: (samples,), increasing times of at least `MIN_SAMPLES` samples.
        position_m: (samples, 3), world.
        orientation_wxyz: (samples, 4), unit quaternions that turn body into world coordinates, or None.

    Raises:
        SettingsError: too few samples, times that do not increase, or a number that is not finite.
    """

    time_s: Float[np.ndarray, "samples"]
    position_m: Float[np.ndarray, "samples 3"]
    orientation_wxyz: Float[np.ndarray, "samples 4"] | None

    def __post_init__(self) -> None:
        if len(self.time_s) < MIN_SAMPLES:
            raise SettingsError(
                "recording", expected=f"at least {MIN_SAMPLES} samples", found=f"{len(self.time_s)}"
            )
        if not np.all(np.diff(self.time_s) > 0):
            index = int(np.argmin(np.diff(self.time_s) > 0)) + 1
            raise SettingsError(
                "recording",
                expected="times that increase",
                found=f"{self.time_s[index]:g} s at sample {index}",
            )
        for values in (self.position_m, self.orientation_wxyz):
            if values is not None and not np.isfinite(values).all():
                index = int(np.argmin(np.isfinite(values).all(axis=1)))
                raise SettingsError(
                    "recording", expected="finite numbers", found=f"NaN or infinity at sample {index}"
                )

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return float(self.time_s[-1] - self.time_s[0])


# --- files


def read_recorded_flight(path: str | Path) -> Recorded:
    """Read the flight of one drone from a file of `write_recorded_flight`, a trajectory, or a pose file of DPJAIT.

    Recorded flights and trajectories have the columns `time_s`, `x_m`, `y_m`, `z_m` and, optionally, `qw`, `qx`, `qy`,
    `qz`, separated by commas or semicolons; the column `drone` of a trajectory must have the same value in all rows. A
    pose file (`dronN_pos_25.csv`) has its rate in its name; its placeholder at frame 0 is left out.

    Raises:
        InputError: the file cannot be read, a column is missing, the times do not increase, there are fewer than
            `MIN_SAMPLES` samples, a value is missing or NaN, or a quaternion does not have length 1. The message names
            file, line and column.
    """
    header = read_rows(path, ";")[:1]
    table = read_table(path, ";" if header and len(header[0].cells) > 1 else ",")
    recorded = _from_poses(Path(path)) if table.find("id") and table.find("pos_x") else _from_table(table)
    time_s, position_m, orientation_wxyz = recorded
    if len(time_s) < MIN_SAMPLES:
        raise InputError(path, expected=f"at least {MIN_SAMPLES} samples", found=f"{len(time_s)}")
    return Recorded(time_s, position_m, orientation_wxyz)


def write_recorded_flight(
    path: str | Path,
    time_s: Float[np.ndarray, "samples"],
    position_m: Float[np.ndarray, "samples 3"],
    orientation_wxyz: Float[np.ndarray, "samples 4"] | None,
) -> None:
    """Write `time_s,x_m,y_m,z_m[,qw,qx,qy,qz]`, all digits, so that reading gives the same numbers.

    Raises:
        SettingsError: the samples are not valid for `Recorded`.
        OutputError: the file cannot be written; an existing file is unchanged.
    """
    recorded = Recorded(time_s, position_m, orientation_wxyz)
    columns = [recorded.time_s[:, None], recorded.position_m]
    header = ["time_s", *_POSITION]
    if recorded.orientation_wxyz is not None:
        columns.append(recorded.orientation_wxyz)
        header += _QUATERNION
    write_rows(path, [header, *np.hstack(columns).tolist()], ",")


_Samples = tuple[Times, Vectors, Float[np.ndarray, "times 4"] | None]


def _from_poses(path: Path) -> _Samples:
    match = _POSE_FILE.fullmatch(path.name)
    rate_hz = float(match["rate_hz"]) if match else 0.0
    if rate_hz == 0:
        raise InputError(
            path, expected="a pose file named like dron1_pos_25.csv, with its rate", found=path.name
        )
    position_m, orientation_wxyz = read_poses(path)
    frame = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    return frame / rate_hz, position_m[frame], None if orientation_wxyz is None else orientation_wxyz[frame]


def _from_table(table: Table) -> _Samples:
    _check_one_drone(table)
    time = table.column("time_s")
    position = [table.column(name) for name in _POSITION]
    quaternion = [table.column(name) for name in _QUATERNION] if table.find(_QUATERNION[0]) else []
    time_s = np.array([row.number(time) for row in table.rows])
    again = first_repeat(time_s)
    if again is not None:
        before, row = table.rows[again - 1 : again + 1]
        raise row.error(
            time, f"a time above {before.text(time)}, the time in line {before.line}", row.text(time)
        )
    position_m = np.array([[row.number(column) for column in position] for row in table.rows])
    orientation_wxyz = (
        np.array([unit_quaternion(row, quaternion) for row in table.rows]) if quaternion else None
    )
    return time_s, position_m, orientation_wxyz


def _check_one_drone(table: Table) -> None:
    column = table.find("drone")
    if column is None:
        return
    name = table.rows[0].text(column)
    for row in table.rows:
        if row.text(column) != name:
            raise row.error(
                column, f"one drone, {name} as above", row.text(column), "keep the rows of one drone only"
            )


# --- flights


def recorded_flight(record: FlightFromFile, heading: Heading) -> RecordedFlight:
    """Read the recorded flight that a scenario names; `heading` is used if the file has no orientations.

    Raises:
        InputError: `read_recorded_flight` cannot read the file.
        SettingsError: the recorded flight ends before `start_s`.
    """
    recorded = read_recorded_flight(Path(record.file))
    if record.start_s >= recorded.duration_s:
        raise SettingsError(
            f"start_s of {record.file}",
            expected=f"less than its duration, {recorded.duration_s:g} s",
            found=f"{record.start_s:g}",
        )
    return RecordedFlight(recorded, heading, record.start_s, np.array(record.offset_m), record.file)


@dataclass(frozen=True)
class RecordedFlight(Flight):
    """A recorded flight that is replayed.

    The flight is extrapolated by a short time before the first and after the last sample, for the exposures of the
    first and last frame. Times further outside raise `SettingsError`; the message says how many times are inside.

    Attributes:
        recorded: samples of the flight.
        heading: heading for samples without orientations; their attitude follows from the acceleration.
        start_s: time after the first sample that becomes the flight's time 0.
        offset_m: (3,), vector that is added to the positions.
        name: name for messages.
    """

    recorded: Recorded
    heading: Heading
    start_s: float
    offset_m: Float[np.ndarray, "3"]
    name: str

    @cached_property
    def _splines(self) -> tuple[BSpline, BSpline, BSpline]:
        """Position, velocity and acceleration over the time of the samples."""
        position = spline(self.recorded.time_s, self.recorded.position_m)
        return position, position.derivative(1), position.derivative(2)

    @cached_property
    def _attitude(self) -> RotationSpline | None:
        orientation_wxyz = self.recorded.orientation_wxyz
        if orientation_wxyz is None:
            return None
        return RotationSpline(self.recorded.time_s, Rotation.from_quat(orientation_wxyz, scalar_first=True))

    def check(self, time_s: Times) -> None:
        """Raise `SettingsError` if a given time of a frame is outside the samples."""
        self._own_time(time_s, _ROUNDING_S)

    def _own_time(
        self, time_s: Times, beyond_s: float = _BEYOND_S
    ) -> tuple[Times, Float[np.ndarray, "times 1"]]:
        """Times within the samples that are nearest to the given times, and the differences to the given times."""
        samples_s = self.recorded.time_s
        first_s = self.start_s + float(np.min(time_s, initial=0.0))
        if first_s < -beyond_s:
            raise SettingsError(
                self.name,
                expected=f"a start_s of at least {self.start_s - first_s:.6g} s",
                found=f"{self.start_s:.6g} s",
                remedy="the drone that follows with a delay begins at an earlier point of the recording",
            )
        own_s = samples_s[0] + self.start_s + time_s
        inside_s = np.clip(own_s, samples_s[0], samples_s[-1])
        fit = np.abs(own_s - inside_s) <= beyond_s
        if not fit.all():
            raise SettingsError(
                self.name,
                expected=f"a recording of at least {self.start_s + float(np.max(time_s)):.6g} s",
                found=f"{self.recorded.duration_s:.6g} s",
                remedy=f"{np.count_nonzero(fit)} of the {len(fit)} frames would fit",
            )
        return inside_s, (own_s - inside_s)[:, None]

    def position_m(self, time_s: Times) -> Vectors:
        """(times, 3), world, metres."""
        own_s, beyond_s = self._own_time(time_s)
        position, velocity, acceleration = (curve(own_s) for curve in self._splines)
        return self.offset_m + position + velocity * beyond_s + acceleration * beyond_s**2 / 2

    def velocity_m_s(self, time_s: Times) -> Vectors:
        """(times, 3), world."""
        own_s, beyond_s = self._own_time(time_s)
        _, velocity, acceleration = (curve(own_s) for curve in self._splines)
        return velocity + acceleration * beyond_s

    def acceleration_m_s2(self, time_s: Times) -> Vectors:
        """(times, 3), world, gravity not included."""
        return self._splines[2](self._own_time(time_s)[0])

    def rotation(self, time_s: Times) -> Float[np.ndarray, "times 3 3"]:
        """(times, 3, 3), body to world: as recorded, or from the acceleration if no orientations were recorded."""
        if self._attitude is None:
            return super().rotation(time_s)
        return self._attitude(self._own_time(time_s)[0]).as_matrix()

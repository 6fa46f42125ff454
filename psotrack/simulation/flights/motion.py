"""Flights: positions with derivatives at any time, and the attitudes that follow from the acceleration.

The thrust of a multirotor acts along its body's z axis only, so this axis points along a + g (Mellinger and Kumar,
"Minimum snap trajectory generation and control for quadrotors", 2011; drag is neglected). The heading is free.
Flights from formulas (harmonics, relative and delayed flights, waypoints) have exact derivatives. A quintic spline goes
through the samples of a recorded flight, from motion capture, a tracker or `psotrack simulate fly`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline
from scipy.spatial.transform import Rotation, RotationSpline

from psotrack.errors import InputError, SettingsError
from psotrack.recordings.exchange import read_tracks
from psotrack.simulation.scenarios import FlightFromFile
from psotrack.trajectories import Trajectories, write_trajectories

Turns = Float[np.ndarray, "times 3 3"]
_Quaternions = Float[np.ndarray, "samples 4"]
GRAVITY_M_S2 = 9.81

Times = Float[np.ndarray, "times"]
Vectors = Float[np.ndarray, "times 3"]


@dataclass(frozen=True)
class Heading:
    """Heading of a drone over time: `yaw + sway sin(angular t + phase)`, radians and rad/s."""

    yaw_rad: float = 0.0
    sway_rad: float = 0.0
    angular_rad_s: float = 1.0
    phase_rad: float = 0.0

    def at(self, time_s: Times) -> Times:
        """(times,), heading at each time, radians."""
        return self.yaw_rad + self.sway_rad * np.sin(self.angular_rad_s * time_s + self.phase_rad)


def attitude(thrust_m_s2: Vectors, yaw_rad: Times) -> Turns:
    """(times, 3, 3), body to world: z along the thrust, x as near to the heading as possible."""
    body_z = thrust_m_s2 / np.linalg.norm(thrust_m_s2, axis=-1, keepdims=True)
    ahead = np.stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)], axis=-1)
    body_y = np.cross(body_z, ahead)
    body_y /= np.linalg.norm(body_y, axis=-1, keepdims=True)
    return np.stack([np.cross(body_y, body_z), body_y, body_z], axis=-1)


def quaternions_wxyz(rotation: Turns) -> Float[np.ndarray, "times 4"]:
    """(times, 4), unit quaternions, scalar first; their signs do not change from one time to the next."""
    wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    # `np.sign` would be 0 after half a turn.
    flips = np.where((wxyz[1:] * wxyz[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    return wxyz * np.cumprod(np.concatenate([[1.0], flips]))[:, None]


class Flight(ABC):
    """A twice differentiable position over time, with a heading.

    Attributes:
        heading: direction of the drone's x axis, seen from above.
    """

    heading: Heading

    @abstractmethod
    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), derivative of the position: 0 is the position itself, 1 the velocity, 2 the acceleration."""

    def position_m(self, time_s: Times) -> Vectors:
        """(times, 3), world, metres."""
        return self.derivative(time_s, 0)

    def velocity_m_s(self, time_s: Times) -> Vectors:
        """(times, 3), world."""
        return self.derivative(time_s, 1)

    def acceleration_m_s2(self, time_s: Times) -> Vectors:
        """(times, 3), world, gravity not included."""
        return self.derivative(time_s, 2)

    def rotation(self, time_s: Times) -> Turns:
        """(times, 3, 3), body to world: z along a + g, x as near to the heading as possible."""
        thrust_m_s2 = self.acceleration_m_s2(time_s) + np.array([0.0, 0.0, GRAVITY_M_S2])
        return attitude(thrust_m_s2, self.heading.at(time_s))

    def tilt_deg(self, time_s: Times) -> Times:
        """(times,), angle between the body's z axis and the vertical, degrees."""
        return np.degrees(np.arccos(np.clip(self.rotation(time_s)[:, 2, 2], -1, 1)))

    def orientation_wxyz(self, time_s: Times) -> Float[np.ndarray, "times 4"]:
        """(times, 4), unit quaternions, body to world; their signs do not change from one time to the next."""
        return quaternions_wxyz(self.rotation(time_s))


@dataclass(frozen=True)
class HarmonicFlight(Flight):
    """A flight that is a sum of sinusoids about a centre.

    Attributes:
        centre_m: (3,), centre, world.
        amplitude_m: (harmonics, 3), amplitudes along each axis.
        angular_rad_s: (harmonics,), angular frequencies.
        phase_rad: (harmonics, 3), phases at time 0.
        heading: heading of the drone.
    """

    centre_m: Float[np.ndarray, "3"]
    amplitude_m: Float[np.ndarray, "harmonics 3"]
    angular_rad_s: Float[np.ndarray, "harmonics"]
    phase_rad: Float[np.ndarray, "harmonics 3"]
    heading: Heading

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3); the n-th derivative of a sine is the sine with n quarter turns added to its angle."""
        w = self.angular_rad_s[:, None]
        angle = w * time_s[:, None, None] + self.phase_rad + order * np.pi / 2
        moved_m = (self.amplitude_m * w**order * np.sin(angle)).sum(axis=1)
        return moved_m if order else self.centre_m + moved_m


@dataclass(frozen=True)
class RelativeFlight(Flight):
    """A flight relative to another flight: the sum of the other flight and an offset.

    Attributes:
        other: flight of the other drone.
        offset: offset from the other drone over time, world axes; its heading is not used.
        heading: heading of the drone.
    """

    other: Flight
    offset: Flight
    heading: Heading

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), sum of both derivatives."""
        return self.other.derivative(time_s, order) + self.offset.derivative(time_s, order)


@dataclass(frozen=True)
class DelayedFlight(Flight):
    """The flight of another drone with a delay.

    Attributes:
        leader: flight of the other drone; its formula also holds before time 0.
        delay_s: the delay.
        heading: heading of the drone.
    """

    leader: Flight
    delay_s: float
    heading: Heading

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), derivative of the leader at an earlier time."""
        return self.leader.derivative(time_s - self.delay_s, order)


#: Share of the distance after a share t of the time, for the motion with minimum jerk from rest to rest, and its two
#: derivatives: 10 t^3 - 15 t^4 + 6 t^5 (Flash and Hogan, "The coordination of arm movements", 1985).
_MINIMUM_JERK = tuple(np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0]).deriv(n) for n in (0, 1, 2))


@dataclass(frozen=True)
class WaypointFlight(Flight):
    """A flight around a closed loop of points, with a stop at each point and minimum jerk between the points.

    Attributes:
        points_m: (points, 3), world; the first point follows the last.
        moving_s: (points,), times of the motion from each point to the next.
        hover_s: time that the drone stands still at each point before it moves.
        heading: heading of the drone.
    """

    points_m: Float[np.ndarray, "points 3"]
    moving_s: Float[np.ndarray, "points"]
    hover_s: float
    heading: Heading

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), derivative of the motion along the leg of each time."""
        ends_s = np.cumsum(self.moving_s + self.hover_s)
        loop_s = time_s % ends_s[-1]
        # Rounding can place the end of the loop after the last leg.
        leg = np.minimum(np.searchsorted(ends_s, loop_s, side="right"), len(ends_s) - 1)
        moving_s = self.moving_s[leg]
        share = np.clip((loop_s - ends_s[leg]) / moving_s + 1, 0, 1)
        leg_m = (np.roll(self.points_m, -1, axis=0) - self.points_m)[leg]
        moved = (_MINIMUM_JERK[order](share) / moving_s**order)[:, None] * leg_m
        return self.points_m[leg] + moved if order == 0 else moved


_DEGREE = 5
#: Smallest number of samples for a quintic spline.
MIN_SAMPLES = _DEGREE + 1
#: Largest noise of the acceleration without smoothing; it tilts a drone by 3 degrees.
_NOISE_M_S2 = 0.5
#: Standard deviation of the second derivative of a quintic spline through white noise, times the squared spacing,
#: divided by the standard deviation of the noise; found by simulation.
_NOISE_GAIN = 3.84
#: Smallest time, and smallest number of samples, between two knots.
_KNOT_S = 0.25
_SAMPLES_PER_KNOT = 3

Samples = Float[np.ndarray, "samples"]
Positions = Float[np.ndarray, "samples 3"]


def spline(time_s: Samples, position_m: Positions) -> BSpline:
    """Quintic spline through samples, or near samples with noise.

    Args:
        time_s: (samples,), increasing times of at least `MIN_SAMPLES` samples.
        position_m: (samples, 3), world.

    Returns:
        Position over time, (times, 3).
    """
    # The shortest spacing, because two nearly simultaneous samples that differ give the largest acceleration.
    spacing_s = float(np.diff(time_s).min())
    if _NOISE_GAIN * _noise_m(time_s, position_m) / spacing_s**2 <= _NOISE_M_S2:
        return make_interp_spline(time_s, position_m, k=_DEGREE)
    first, last = (np.repeat(end, _DEGREE + 1) for end in (time_s[0], time_s[-1]))
    return make_lsq_spline(time_s, position_m, np.concatenate([first, _knots_s(time_s), last]), k=_DEGREE)


def _noise_m(time_s: Samples, position_m: Positions) -> float:
    """Standard deviation, along the worst axis, of the samples' differences from the quintic through six neighbours."""
    if len(time_s) <= MIN_SAMPLES:
        return 0.0
    window_s = np.lib.stride_tricks.sliding_window_view(time_s, 7)
    window_m = np.lib.stride_tricks.sliding_window_view(position_m, 7, axis=0)
    here_s, others = window_s[:, 3], [0, 1, 2, 4, 5, 6]
    weights = np.zeros_like(window_s)
    weights[:, 3] = -1.0
    for j in others:
        rest_s = window_s[:, [m for m in others if m != j]]
        # Lagrange polynomials at the time of the middle sample.
        weights[:, j] = np.prod((here_s[:, None] - rest_s) / (window_s[:, j, None] - rest_s), axis=1)
    residual_m = np.einsum("nj,naj->na", weights, window_m) / np.linalg.norm(weights, axis=1, keepdims=True)
    # The median ignores the few jerks of a person at the sticks, which are no noise. The median of the absolute value
    # of a Gaussian is 0.6745 standard deviations.
    return float(np.median(np.abs(residual_m), axis=0).max()) / 0.6745


def _knots_s(time_s: Samples) -> Times:
    """(knots,), sample times with `_KNOT_S` and `_SAMPLES_PER_KNOT` between them, so that the fit is unique."""
    knots: list[int] = []
    index = 0
    while True:
        index = max(int(np.searchsorted(time_s, time_s[index] + _KNOT_S)), index + _SAMPLES_PER_KNOT)
        if index + _SAMPLES_PER_KNOT >= len(time_s):
            break
        knots.append(index)
    # The first and last interval are twice as long: with samples on one side only, the noise of the acceleration would
    # be five times as large there.
    knots = knots[1:-1]
    return time_s[knots if len(knots) + MIN_SAMPLES <= len(time_s) else []]


#: Largest time before the first and after the last sample that a flight is extrapolated to. It is longer than half an
#: exposure, because the exposures of the first and last frame reach beyond the samples.
_BEYOND_S = 0.1
#: Tolerance for times of frames and times of samples, which come from different divisions.
_ROUNDING_S = 1e-6


@dataclass(frozen=True)
class Recorded:
    """Samples of a flight.

    Attributes:
        time_s: (samples,), increasing times.
        position_m: (samples, 3), world.
        orientation_wxyz: (samples, 4), unit quaternions that turn body into world coordinates, or None.
    """

    time_s: Samples
    position_m: Positions
    orientation_wxyz: _Quaternions | None

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return float(self.time_s[-1] - self.time_s[0])


def read_recorded_flight(path: str | Path) -> Recorded:
    """Read the flight of one drone from tracks in any format of `read_tracks`; rows without a position are left out.

    Raises:
        InputError: the file cannot be read, has no drone or several, fewer than `MIN_SAMPLES` positions, or positions
            with and without an orientation.
    """
    tracks = read_tracks(path)
    if tracks.num_drones != 1:
        found = ", ".join(tracks.drones)
        raise InputError(
            path, expected="the flight of one drone", found=found, remedy="keep one drone's rows"
        )
    known = np.isfinite(tracks.position_m[:, 0]).all(axis=1)
    if np.count_nonzero(known) < MIN_SAMPLES:
        found = f"{np.count_nonzero(known)}"
        raise InputError(path, expected=f"at least {MIN_SAMPLES} positions", found=found)
    turned = None if tracks.orientation_wxyz is None else tracks.orientation_wxyz[known, 0]
    if turned is not None and not np.isfinite(turned).all():
        found = f"none at {tracks.time_s[known][~np.isfinite(turned).all(axis=1)][0]:g} s"
        raise InputError(path, expected="an orientation with each position, or no orientations", found=found)
    return Recorded(tracks.time_s[known], tracks.position_m[known, 0], turned)


def write_recorded_flight(
    path: str | Path, time_s: Samples, position_m: Positions, orientation_wxyz: _Quaternions | None
) -> None:
    """Write the tracks of one drone, .csv or .parquet, with all digits, so that reading gives the same numbers.

    Raises:
        InputError: the path has another suffix.
        OutputError: the file cannot be written; an existing file is unchanged.
    """
    turned = None if orientation_wxyz is None else orientation_wxyz[:, None]
    frame = np.arange(len(time_s))
    tracks = Trajectories(frame, time_s, ("dron1",), position_m[:, None], orientation_wxyz=turned)
    write_trajectories(path, tracks, force=True)


def recorded_flight(record: FlightFromFile, heading: Heading) -> RecordedFlight:
    """Read the recorded flight that a scenario names; `heading` is used if the file has no orientations.

    Raises:
        InputError: `read_recorded_flight` cannot read the file.
    """
    recorded = read_recorded_flight(record.file)
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
    def _spline(self) -> BSpline:
        return spline(self.recorded.time_s, self.recorded.position_m)

    @cached_property
    def _attitude(self) -> RotationSpline | None:
        orientation_wxyz = self.recorded.orientation_wxyz
        if orientation_wxyz is None:
            return None
        return RotationSpline(self.recorded.time_s, Rotation.from_quat(orientation_wxyz, scalar_first=True))

    def check(self, time_s: Times) -> None:
        """Raise `SettingsError` if a given time of a frame is outside the samples."""
        self._own_time(time_s, _ROUNDING_S)

    def _own_time(self, time_s: Times, beyond_s: float = _BEYOND_S) -> Times:
        """Times of the samples' clock; raises `SettingsError` for a time further outside the samples."""
        first_s, last_s = self.recorded.time_s[[0, -1]]
        earliest_s = self.start_s + float(np.min(time_s, initial=0.0))
        if earliest_s < -beyond_s:
            raise SettingsError(
                self.name,
                expected=f"a start_s of at least {self.start_s - earliest_s:.6g} s",
                found=f"{self.start_s:.6g} s",
                remedy="the drone that follows with a delay begins at an earlier point of the recording",
            )
        own_s = first_s + self.start_s + time_s
        fit = own_s - last_s <= beyond_s
        if not fit.all():
            raise SettingsError(
                self.name,
                expected=f"a recording of at least {self.start_s + float(np.max(time_s)):.6g} s",
                found=f"{self.recorded.duration_s:.6g} s",
                remedy=f"{np.count_nonzero(fit)} of the {len(fit)} frames would fit",
            )
        return own_s

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), of the spline, whose ends are continued for the exposures of the first and last frame."""
        return self._spline(self._own_time(time_s), order) + self.offset_m * (order == 0)

    def rotation(self, time_s: Times) -> Turns:
        """(times, 3, 3), body to world: as recorded, or from the acceleration if no orientations were recorded."""
        if self._attitude is None:
            return super().rotation(time_s)
        first_s, last_s = self.recorded.time_s[[0, -1]]
        return self._attitude(np.clip(self._own_time(time_s), first_s, last_s)).as_matrix()

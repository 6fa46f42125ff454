"""When each frame of each camera was exposed, and which frames belong to one instant.

Every camera has a rate and a start of its own, on the one clock of the recording. A recording is tracked at instants of
this clock: at each instant, each camera shows its nearest frame, and the frame's time is kept, because the drones have
moved between the instant and the frame. Cameras with equal frame times meet without differences: frame i is instant i.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.support import first_repeat, read_table, short_repr

_Times = Float[np.ndarray, "instants"]
_Rows = Float[np.ndarray, "rows"]
#: Largest distance of a frame from an instant at which the frame is shown, in intervals of the frame's camera: half an
#: interval, and a tenth for times that jitter.
REACH = 0.6
#: Times nearer than this share of an interval are one time: rates such as 30000/1001 are rounded in files.
_SAME = 1e-6
#: Largest distance of a time in a file of tracks from the instant that it means, seconds: the rounding of times that
#: are written in milliseconds, but at least and at most these shares of an interval. In 2 % of 40 ms, a drone at 2 m/s
#: flies 1.6 mm.
_ROUNDED_S, _ROUNDED_SHARES = 0.6e-3, (0.02, 0.25)
#: Units in which other programs write times, and how many of each a second has.
_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
#: Of times that are a thousandth of what they seem to be, at most this share is within the recording.
_FEW = 0.005
#: Lowest and highest rate of a camera with which drones are tracked, frames per second. With one frame in a quarter of
#: an hour there is no motion to follow. With the highest rate, a drone at 20 m/s moves by a millimetre from frame to
#: frame, and more frames show nothing new; what is higher is the tick of a container's clock (90 000 Hz), or a slip.
RATES_HZ = (1e-3, 2e4)
#: Largest number of instants: a day at 115 Hz. A recording with more instants has a wrong rate or a wrong clock.
MOST_INSTANTS = 10_000_000


def check_rate(where: object, fps: float, remedy: str = "") -> None:
    """Raise `InputError` for a rate with which no camera films drones.

    Args:
        where: the file, table or setting that states the rate, for the message.
        fps: frames per second.
        remedy: what the user can do, for the message.
    """
    low, high = RATES_HZ
    if not low <= fps <= high:
        raise InputError(
            where, expected=f"{low:g} to {high:.0f} frames per second", found=f"{fps:g}", remedy=remedy
        )


@dataclass(frozen=True, repr=False)
class FrameTimes:
    """When the frames of one camera were exposed, on the recording's clock.

    Attributes:
        num_frames: number of frames.
        fps: frames per second; for listed times 1 / median interval.
        time_offset_s: time of frame 0, seconds.
        listed_s: time of each frame, seconds; None where frame i was exposed at `time_offset_s` + i / `fps`.

    Raises:
        SettingsError: the rate is not above 0, the number of frames is negative or
            above that of a day, or the time of frame 0 is not finite.
    """

    num_frames: int
    fps: float
    time_offset_s: float = 0.0
    listed_s: tuple[float, ...] | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_positive("fps", self.fps)
        if not 0 <= self.num_frames <= MOST_INSTANTS:
            raise SettingsError(
                "num_frames", expected=f"a number from 0 to {MOST_INSTANTS}", found=f"{self.num_frames}"
            )
        if not np.isfinite(self.time_offset_s):
            raise SettingsError("time_offset_s", expected="a finite number", found=f"{self.time_offset_s:g}")

    @classmethod
    def listed(cls, time_s: Float[np.ndarray, "frames"], where: object = "timestamps") -> FrameTimes:
        """Frame times from a list.

        Args:
            time_s: (frames,), time of each frame, seconds, increasing.
            where: the file or setting that the times come from, for messages.

        Raises:
            InputError: there are fewer than two times, a time is not finite, a time is not later than the time
                before it, or the rate is one with which no camera films drones.
        """
        if len(time_s) < 2:
            raise InputError(where, expected="times of at least 2 frames", found=f"{len(time_s)}")
        if not np.isfinite(time_s).all():
            frame = int(np.flatnonzero(~np.isfinite(time_s))[0])
            raise InputError(where, expected="finite times", found=f"{time_s[frame]} s for frame {frame}")
        again = first_repeat(time_s)
        if again is not None:
            raise InputError(
                where,
                expected="times that increase from frame to frame",
                found=f"{time_s[again]:g} s for frame {again} after {time_s[again - 1]:g} s",
            )
        fps = float(1 / np.median(np.diff(time_s)))
        check_rate(where, fps, "are the times in seconds?")
        return cls(len(time_s), fps, float(time_s[0]), tuple(time_s.tolist()))

    @property
    def time_s(self) -> Float[np.ndarray, "frames"]:
        """(frames,), time of each frame, seconds."""
        if self.listed_s is not None:
            return np.array(self.listed_s, np.float64)
        return self.time_offset_s + np.arange(self.num_frames) / self.fps

    def cut(self, num_frames: int) -> FrameTimes:
        """The times of the first frames only."""
        listed = None if self.listed_s is None else self.listed_s[:num_frames]
        return replace(self, num_frames=min(num_frames, self.num_frames), listed_s=listed)

    def corrected(self, offset_s: float, drift: float = 0.0) -> FrameTimes:
        """The times t + offset + drift * t, where t are these times.

        Args:
            offset_s: seconds that are added to every time.
            drift: seconds that are added per second, above -1.
        """
        stretch = 1 + drift
        check_positive("1 + drift", stretch)
        return FrameTimes(
            self.num_frames,
            float(self.fps / stretch),
            float(self.time_offset_s * stretch + offset_s),
            None if self.listed_s is None else tuple((np.array(self.listed_s) * stretch + offset_s).tolist()),
        )

    def is_like(self, other: FrameTimes) -> bool:
        """Whether frames of equal number have equal times; the numbers of frames may differ."""
        if self.listed_s is not None or other.listed_s is not None:
            common = min(self.num_frames, other.num_frames)
            return bool((np.abs(self.time_s[:common] - other.time_s[:common]) * self.fps < _SAME).all())
        same_rate = abs(self.fps - other.fps) * max(self.num_frames, other.num_frames) < 1e-3 * self.fps
        apart_s = abs(self.time_offset_s - other.time_offset_s)
        return bool(same_rate and apart_s * self.fps < _SAME)


def read_timestamps(path: Path | str, num_frames: int | None = None) -> FrameTimes:
    """Read the times of a camera's frames.

    Args:
        path: CSV file with the columns `frame`, which counts from 0, and `time_s`, seconds.
        num_frames: number of frames that the camera has; None is not known.

    Raises:
        InputError: the file cannot be read, a frame is missing, there is not one time per frame, or times do not
            increase. The message names the line or the frame.
    """
    path = Path(path)
    table = read_table(path, ",")
    frame_column, time_column = table.column("frame"), table.column("time_s")
    for number, row in enumerate(table.rows):
        if row.count(frame_column) != number:
            expected = f"frame {number}: every frame once, in order, from 0"
            raise row.error(frame_column, expected, row.text(frame_column))
    time_s = np.array([row.number(time_column) for row in table.rows])
    if num_frames is not None and len(time_s) != num_frames:
        raise InputError(
            path, expected=f"times of the {num_frames} frames of the video", found=f"{len(time_s)}"
        )
    return FrameTimes.listed(time_s, path)


@dataclass(frozen=True, repr=False)
class Timeline:
    """The instants at which a recording is tracked, and the frame that each camera shows at each instant.

    Attributes:
        cameras: names of the cameras.
        rate_hz: instants per second.
        time_s: (instants,), time of each instant on the recording's clock, seconds.
        frame: (instants, cameras), number of the frame, in the camera's own counting, that is nearest to the instant;
            -1 where the camera has no frame near the instant, because it starts late, ends early or dropped the frame.
        offset_s: (instants, cameras), the frame's time minus the instant's time, seconds; 0 where there is no frame.
            Of a rolling shutter it is the time of the image's middle row.
        line_time_s: (cameras,), time from the exposure of one row to that of the next row, seconds; None where all
            rows of all cameras are exposed together.
    """

    cameras: tuple[str, ...]
    rate_hz: float
    time_s: _Times
    frame: Int[np.ndarray, "instants cameras"]
    offset_s: Float[np.ndarray, "instants cameras"]
    line_time_s: Float[np.ndarray, "cameras"] | None = None

    __repr__ = short_repr

    @property
    def num_instants(self) -> int:
        """Number of instants."""
        return len(self.time_s)

    def part(self, instants: slice | Int[np.ndarray, "chosen"]) -> Timeline:
        """Some of the instants."""
        return replace(
            self,
            time_s=self.time_s[instants],
            frame=self.frame[instants],
            offset_s=self.offset_s[instants],
        )

    @property
    def is_there(self) -> Bool[np.ndarray, "instants cameras"]:
        """(instants, cameras), whether the camera has a frame near the instant."""
        return self.frame >= 0

    @property
    def share(self) -> Float[np.ndarray, "instants cameras"]:
        """(instants, cameras), 1 / number of instants that show the frame; 0 where there is no frame.

        A frame that several instants show is no new information at each of them.
        """
        share = np.zeros(self.frame.shape)
        for camera, frame in enumerate(self.frame.T):
            there = frame >= 0
            _, which, count = np.unique(frame[there], return_inverse=True, return_counts=True)
            share[there, camera] = 1 / count[which]
        return share

    def has(self, number: Int[np.ndarray, "rows"], time_s: _Rows) -> bool:
        """Whether the instants of these numbers have these times, seconds, in files of tracks."""
        if not len(number) or number[-1] >= self.num_instants:
            return False
        limit = np.clip(_ROUNDED_S * self.rate_hz, *_ROUNDED_SHARES)
        return bool(np.abs(self.time_s[number] - time_s).max() * self.rate_hz <= limit)

    def numbers_of(self, time_s: _Rows) -> Int[np.ndarray, "rows"] | None:
        """(rows,), numbers of the instants with these increasing times, seconds; None unless each has its own."""
        number = _nearest(self.time_s, time_s)
        return number if self.has(number, time_s) and (np.diff(number) > 0).all() else None

    def unit_of(self, time_s: _Rows) -> str:
        """The unit that increasing times of a file seem to have, in the plural; empty where it may be the second.

        Hardly any of such times is within the recording, and their rate is nearer to a thousandth of the recording's.
        """
        inside = ((time_s >= self.time_s[0]) & (time_s <= self.time_s[-1])).sum()
        if len(time_s) < 3 or inside >= max(3, _FEW * len(time_s)):
            return ""
        times = float(np.median(np.diff(time_s))) * self.rate_hz
        return next((unit for unit, each in _UNITS.items() if each <= times * 10**1.5 < 1e3 * each), "")

    @property
    def is_synchronous(self) -> bool:
        """Whether frame i of every camera is instant i, without differences in time, and has no rolling shutter."""
        if self.line_time_s is not None:
            return False
        return bool((self.frame == np.arange(self.num_instants)[:, None]).all() and not self.offset_s.any())


def make_timeline(frame_times: Mapping[str, FrameTimes], rate_hz: float | None = None) -> Timeline:
    """The instants of cameras with given frame times.

    Instants are the multiples of 1 / rate from time 0 on, until no camera has a frame. If frames of equal number have
    equal times in all cameras, and no other rate is asked for, instants are the times of the frames, from time 0 on.

    Args:
        frame_times: frame times by camera name.
        rate_hz: instants per second; None is the rate of the fastest camera.

    Raises:
        SettingsError: the rate is not above 0.
        InputError: no camera has a frame at time 0 or later, or there are more than `MOST_INSTANTS` instants.
    """
    if rate_hz is not None:
        check_positive("rate", rate_hz)
    times = list(frame_times.values())
    fastest = max((each.fps for each in times), default=1.0)
    rate = fastest if rate_hz is None else rate_hz
    longest = max(times, key=lambda each: each.num_frames, default=FrameTimes(0, rate))
    if abs(rate - fastest) < 1e-9 * rate and all(longest.is_like(each) for each in times):
        timeline = _of_equal_frames(tuple(frame_times), times, longest)
    else:
        _check_length(frame_times, rate)
        timeline = _of_nearest_frames(tuple(frame_times), times, rate)
    if not timeline.num_instants:
        later_s = [time_s for each in times for time_s in each.time_s if time_s >= 0]
        if later_s:
            expected = f"a camera with a frame near one of the instants, {rate:g} Hz from time 0 s on"
            found = f"frames from {min(later_s):g} to {max(later_s):g} s"
            raise InputError("frame times", expected=expected, found=found, remedy="choose another rate")
        raise InputError("frame times", expected="a camera with a frame at time 0 s or later", found="none")
    return timeline


def _check_length(frame_times: Mapping[str, FrameTimes], rate_hz: float) -> None:
    """Raise `InputError` for more than `MOST_INSTANTS` instants: a time or a rate is wrong then."""
    spans_s = {name: each.time_s[[0, -1]].tolist() for name, each in frame_times.items() if each.num_frames}
    if not spans_s:
        return
    last = max(spans_s, key=lambda name: spans_s[name][1])
    first = min(spans_s, key=lambda name: spans_s[name][0])
    end_s, begin_s = spans_s[last][1], spans_s[first][0]
    if end_s * rate_hz <= MOST_INSTANTS:
        return
    found = f"{end_s * rate_hz:.2g}: {rate_hz:g} Hz until {end_s:.2f} s, when camera {last} ends"
    remedy = "check the rates and times of the cameras"
    if begin_s > end_s - begin_s:
        of_first = f"{begin_s:.2f} s, the time of the first frame of camera {first}, from all times"
        remedy = f"the clock must begin with the recording: subtract {of_first}"
    raise InputError(
        "frame times", expected=f"at most {MOST_INSTANTS} instants from time 0 on", found=found, remedy=remedy
    )


def _of_equal_frames(names: tuple[str, ...], times: list[FrameTimes], longest: FrameTimes) -> Timeline:
    first = int(np.searchsorted(longest.time_s, -_SAME / longest.fps))
    number = np.arange(first, longest.num_frames)
    lengths = np.array([each.num_frames for each in times], int)
    frame = np.where(number[:, None] < lengths, number[:, None], -1)
    return Timeline(names, longest.fps, longest.time_s[first:], frame, np.zeros(frame.shape))


def _of_nearest_frames(names: tuple[str, ...], times: list[FrameTimes], rate_hz: float) -> Timeline:
    last_s = max((each.time_s[-1] + REACH / each.fps for each in times if each.num_frames), default=-1.0)
    time_s = np.arange(max(0, int(np.floor(last_s * rate_hz)) + 1)) / rate_hz
    frame = np.full((len(time_s), len(times)), -1)
    offset_s = np.zeros(frame.shape)
    for camera, each in enumerate(times):
        frame[:, camera], offset_s[:, camera] = nearest_frames(each, time_s)
    # Differences far below a thousandth of an interval are rounding of the instants' own times.
    offset_s[np.abs(offset_s) * rate_hz < _SAME] = 0.0
    stop = int(np.flatnonzero((frame >= 0).any(axis=1)).max(initial=-1)) + 1
    return Timeline(names, rate_hz, time_s[:stop], frame[:stop], offset_s[:stop])


def nearest_frames(times: FrameTimes, at_s: _Times) -> tuple[Int[np.ndarray, "instants"], _Times]:
    """The frame of a camera that is nearest to each instant.

    Args:
        times: times of the camera's frames.
        at_s: (instants,), times of the instants, seconds.

    Returns:
        (instants,), numbers of the frames, -1 where no frame is near the instant; and (instants,), the frame's time
        minus the instant's time, seconds, 0 where there is no frame.
    """
    if not times.num_frames:
        return np.full(len(at_s), -1), np.zeros(len(at_s))
    own_s = times.time_s
    nearest = _nearest(own_s, at_s)
    off_s = own_s[nearest] - at_s
    there = np.abs(off_s) * times.fps <= REACH
    return np.where(there, nearest, -1), np.where(there, off_s, 0.0)


def _nearest(sorted_s: Float[np.ndarray, "of"], to_s: Float[np.ndarray, "to"]) -> Int[np.ndarray, "to"]:
    """For each time, the index of the nearest of some increasing times; the earlier one of two equally near."""
    if len(sorted_s) == 1:
        return np.zeros(len(to_s), int)
    after = np.clip(np.searchsorted(sorted_s, to_s), 1, len(sorted_s) - 1)
    earlier = to_s - sorted_s[after - 1] <= sorted_s[after] - to_s
    return np.where(earlier, after - 1, after)

"""A session: worker processes make silhouettes, and the calling thread brings them together and tracks."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np

from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
from psotrack.live.front_end import (
    Arrived,
    CameraSilhouette,
    Ended,
    FilesFinished,
    FilmTask,
    Message,
    Notice,
    Ready,
    RecordingNotice,
    film,
)
from psotrack.live.meeting import CameraCounts, Instant, Meeting
from psotrack.live.recorder import CLOSE_S, CameraRecorder, RecordedCounts
from psotrack.live.search_process import search_beside
from psotrack.live.sources import CameraStream, LiveSource, ReplayedVideo
from psotrack.pipeline import CausalRun, causal_settings
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Exposures, usual_drone_px
from psotrack.support import worker_processes
from psotrack.trajectories import Trajectories

logger = logging.getLogger(__name__)

#: How long an instant waits for cameras, and a frame for the processor, seconds.
WAIT_S = 0.1
#: Largest number of complete instants that wait for the tracker: more are left out, so that the delay does not grow.
_MOST_WAITING = 3
#: Longest time for which the session waits for messages before it looks whether it is to end, seconds.
_LOOK_S = 0.1
#: Time that a worker has to end, seconds.
_END_S = 2.0
#: Time from the start of the sources to the recording's time 0, seconds.
_LEAD_S = 0.2
#: Rate of a stream that does not tell its own, frames per second.
_USUAL_HZ = 25.0


@runtime_checkable
class RowsOutput(Protocol):
    """What takes the rows of each instant: a file, a stream, a socket."""

    def write(self, rows: Trajectories) -> None:
        """Take the rows of an instant."""
        ...


@dataclass(frozen=True)
class LiveCamera:
    """A camera of a session.

    Attributes:
        name: name of the camera in the rig.
        source: source of its frames.
        fps: frames per second.
        line_time_s: time from row to row of a rolling shutter, seconds; 0 for a global shutter.
        ignore: image that is white where nothing counts as foreground; None for no such image.
        recorder: keeps the frames; None where they are not kept.
    """

    name: str
    source: LiveSource
    fps: float
    line_time_s: float = 0.0
    ignore: Path | None = None
    recorder: CameraRecorder | None = None


@dataclass
class LiveResult:
    """What a session has done.

    Attributes:
        instants: number of instants that were tracked.
        left_out: number of instants that were left out, because the computer was too slow.
        delay_s: delay of each instant, from the arrival of its last frame to its rows; of the last hour at most.
        counts: counts of each camera, by name.
        recorded: what happened to the frames that are kept, by the camera's name.
        failed_outputs: errors of outputs that were given up while others went on.
        drones: names of all drones.
        late_searches: number of searches for new drones whose result came too late: the drones' rows begin later than
            those of `track --causal`.
        compile_s: wall time before the first frame, in which programs are compiled and processes start, seconds.
        seconds: wall time from then on, seconds.
    """

    instants: int = 0
    left_out: int = 0
    delay_s: list[float] = field(default_factory=list)
    counts: dict[str, CameraCounts] = field(default_factory=dict)
    recorded: dict[str, RecordedCounts] = field(default_factory=dict)
    failed_outputs: list[OutputError] = field(default_factory=list)
    drones: set[str] = field(default_factory=set)
    late_searches: int = 0
    compile_s: float = 0.0
    seconds: float = 0.0


def live_cameras(
    recording: Recording,
    names: Sequence[str] | None = None,
    *,
    replay: bool,
    speed: float = 1.0,
    loops: int = 1,
) -> list[LiveCamera]:
    """The cameras of a recording that have a source of frames: streams and devices, or videos that are replayed.

    Args:
        recording: the recording.
        names: names of the cameras to use; None: all that have a source.
        replay: play the videos.
        speed: seconds of video per second.
        loops: how often the videos are played.

    Raises:
        InputError: fewer than two cameras have a source.
        SettingsError: a name is unknown.
    """
    unknown = sorted(set(names or ()) - set(recording.rig.names))
    if unknown:
        raise SettingsError("cameras", expected=f"some of {', '.join(recording.rig.names)}", found=unknown[0])
    found = []
    for index, name in enumerate(recording.rig.names):
        source: LiveSource
        if replay and name in recording.videos:
            times = recording.frame_times[name]
            source, fps = ReplayedVideo(recording.videos[name], times.time_s, speed, loops), times.fps
        elif not replay and name in recording.streams:
            address = recording.streams[name]
            size_wh = recording.rig.cameras.image_size_wh[index].astype(int).tolist()
            source = CameraStream(address, (size_wh[0], size_wh[1]))
            fps = recording.frame_times[name].fps if name in recording.frame_times else _USUAL_HZ
        else:
            continue
        if names is not None and name not in names:
            continue
        found.append(
            LiveCamera(name, source, fps, recording.line_time_s.get(name, 0.0), recording.ignore.get(name))
        )
    if len(found) < 2:
        what = "videos" if replay else "the address of a stream or the number of a device as `video`"
        raise InputError(
            recording.folder,
            expected=f"at least two cameras of the rig with {what}",
            found=", ".join(each.name for each in found) or "none",
            remedy="" if replay else "--replay plays the videos of a recording",
        )
    return found


class LiveSession:
    """Tracks drones while cameras film.

    Args:
        recording: the rig, and what is known of its cameras.
        cameras: cameras with their sources; other cameras of the rig are not used.
        settings: settings of the run.
        most_drones: largest number of drones at one time.
        first_s: time of the first instant on the recording's clock, seconds.
        wait_s: how long an instant waits for cameras, and a frame for the processor, seconds of the wall clock.
        jobs: largest number of worker processes; None is one per processor.

    Attributes:
        result: what the session has done so far.
        record: rate, settings, seed and volume of the run, fit for JSON.
    """

    def __init__(
        self,
        recording: Recording,
        cameras: list[LiveCamera],
        settings: TrackSettings,
        *,
        most_drones: int = 16,
        first_s: float = 0.0,
        wait_s: float = WAIT_S,
        jobs: int | None = None,
    ) -> None:
        settings = causal_settings(settings)
        names = {each.name for each in cameras}
        self._rig = recording.rig.select([name for name in recording.rig.names if name in names])
        self._cameras = cameras
        sizes_wh = [(int(width), int(height)) for width, height in self._rig.cameras.image_size_wh]
        self._scaled = settings.silhouettes.scaled(sizes_wh, usual_drone_px(recording.rig))
        self._rate_hz = settings.rate_hz or max(each.fps for each in cameras)
        self._wait_s, self._first_s = wait_s, first_s
        self._num_workers = min(jobs or os.cpu_count() or 1, len(cameras))
        sizes = -(-np.asarray(self._rig.cameras.image_size_wh) // self._scaled.reduction)
        self._shape = int(sizes[:, 1].max()), int(sizes[:, 0].max())
        self._line_time_s = np.array([each.line_time_s for each in cameras], np.float32)
        self._run = CausalRun(
            self._rig,
            settings,
            fps=self._rate_hz,
            bounds_m=recording.bounds_m,
            reduction=self._scaled.reduction,
            shape=self._shape,
            most_drones=most_drones,
        )
        self.record = {
            "rate_hz": self._rate_hz,
            "settings": msgspec.to_builtins(settings),
            "seed": settings.seed,
            "volume": self._run.volume,
        }
        # No `threading.Event`: a signal handler that interrupts `set` and calls it again would wait for ever.
        self._is_stopped = False
        self._workers: dict[Connection, list[FilmTask]] = {}
        self._failed: list[BaseException] = []
        #: Cameras that have never filmed or will not film again.
        self._missing: set[int] = set()
        self._said = [""] * len(cameras)
        self.result = LiveResult(counts={each.name: CameraCounts() for each in cameras})

    def stop(self) -> None:
        """End the session after the present instant; from any thread or signal handler."""
        self._is_stopped = True

    def run(
        self,
        outputs: Sequence[RowsOutput],
        on_instant: Callable[[LiveResult, list[bool]], None] | None = None,
        *,
        longest_s: float = float("inf"),
    ) -> LiveResult:
        """Track until all sources have ended, `stop` is called, or the time is over.

        Args:
            outputs: what takes the rows. One that fails is given up with a warning, and the others go on.
            on_instant: is told of the result so far, and which cameras film, after each instant.
            longest_s: time after which the session ends, seconds.

        Raises:
            InputError: fewer than two cameras can film, or no frame came.
            OutputError: the last output has failed.
        """
        tasks = self._tasks()
        outputs = list(outputs)
        with (
            worker_processes(film, tasks) as connections,
            search_beside(self._run.search) as self._run.search,
        ):
            began_s = time.monotonic()
            self._run.compile()
            self.result.compile_s = time.monotonic() - began_s
            early = [message for connection in connections for message in _until_ready(connection)]
            # What was made so far is not searched for garbage again and again, which takes as long as a frame.
            gc.collect()
            gc.freeze()
            # All sources are awake when the first frame comes.
            began_s = time.monotonic() + _LEAD_S
            self._ends_s = began_s + longest_s
            self._meeting = Meeting(
                [each.fps for each in self._cameras],
                self._rate_hz,
                wait_s=self._wait_s,
                began_s=began_s,
                first_s=self._first_s,
            )
            names = (each.name for each in self._cameras)
            self.result.counts = dict(zip(names, self._meeting.counts, strict=True))
            self._workers = dict(zip(connections, tasks, strict=True))
            for message in early:
                self._take(message)
            try:
                for connection in connections:
                    with contextlib.suppress(OSError):  # the worker has died
                        connection.send(began_s)
                self._track_all(began_s, outputs, on_instant)
            finally:
                gc.unfreeze()
                self.stop()
                for connection in self._workers:
                    with contextlib.suppress(OSError):
                        connection.send(None)
                # A worker that has ended closes its pipe.
                is_recorded = any(each.recorder is not None for each in self._cameras)
                end_s = time.monotonic() + _END_S + (CLOSE_S if is_recorded else 0.0)
                while self._workers and time.monotonic() < end_s:
                    self._receive(end_s - time.monotonic())
        bugs = [error for error in self._failed if not isinstance(error, PsotrackError)]
        if bugs:
            raise bugs[0]
        if not self._can_track:
            raise self._error(
                "at least two cameras that film",
                f"{len(self._cameras) - len(self._missing)} of {len(self._cameras)}",
            )
        if not self.result.instants:
            raise self._error("frames", "none until the session ended")
        return self.result

    @property
    def _can_track(self) -> bool:
        """Whether two cameras film, or have filmed and may come back."""
        return len(self._cameras) - len(self._missing) >= 2

    def _error(self, expected: str, found: str) -> InputError:
        remedy = "the lines above say why" if self._missing else ""
        return InputError("the cameras", expected=expected, found=found, remedy=remedy)

    def _track_all(
        self,
        began_s: float,
        outputs: list[RowsOutput],
        on_instant: Callable[[LiveResult, list[bool]], None] | None,
    ) -> None:
        before = None
        for instant, num_left_out in self._instants():
            elapsed = 1 if before is None else instant.number - before
            before = instant.number
            self._track(instant, elapsed, outputs)
            self.result.left_out += num_left_out
            self.result.seconds = time.monotonic() - began_s
            if on_instant is not None:
                on_instant(self.result, self._meeting.films)

    def _tasks(self) -> list[list[FilmTask]]:
        """The cameras of each worker, dealt like cards."""
        tasks = [
            FilmTask(index, camera.source, self._scaled, camera.ignore, self._wait_s, camera.recorder)
            for index, camera in enumerate(self._cameras)
        ]
        return [tasks[worker :: self._num_workers] for worker in range(self._num_workers)]

    def _receive(self, wait_s: float) -> None:
        """Take the messages of the workers, and wait for one; the other workers go on where one dies."""
        for ready in wait(list(self._workers), max(0.0, wait_s)):
            assert isinstance(ready, Connection)
            try:
                while ready.poll():
                    self._take(ready.recv())
            except (OSError, EOFError):
                tasks = self._workers.pop(ready)
                if not self._is_stopped:
                    died = PsotrackError(
                        "a worker process", expected="frames", found="that it died", remedy="is memory short?"
                    )
                    for task in tasks:
                        self._take(Ended(task.index, died))

    def _take(self, message: Message) -> None:
        meeting = self._meeting
        match message:
            case Arrived(index, time_s):
                self._said[index] = ""
                self._missing.discard(index)
                again = " again" if meeting.have_filmed[index] else ""
                if meeting.announce(index, time_s, time.monotonic()):
                    logger.warning("camera %s films%s", self._cameras[index].name, again)
            case CameraSilhouette(index, time_s, arrived_s, coverage):
                if coverage is None:
                    meeting.leave_out(index)
                else:
                    meeting.put(index, time_s, coverage.unpacked(), arrived_s)
            case Notice(index, line):
                if line != self._said[index]:
                    logger.warning("camera %s: %s", self._cameras[index].name, line)
                self._said[index] = line
                if not meeting.have_filmed[index]:
                    self._missing.add(index)
            case RecordingNotice(line):
                logger.warning("%s", line)
            case FilesFinished(index, counts):
                self.result.recorded[self._cameras[index].name] = counts
            case Ended(index, error):
                meeting.end(index)
                if error is not None:
                    logger.warning("camera %s: %s", self._cameras[index].name, error)
                    self._failed.append(error)
                    self._missing.add(index)

    def _instants(self) -> Iterator[tuple[Instant, int]]:
        """Yield instants that are complete, and how many were left out before each."""
        meeting, wait_s = self._meeting, 0.0
        while not self._is_stopped and self._can_track and time.monotonic() < self._ends_s:
            self._receive(wait_s)
            now_s = time.monotonic()
            for index in meeting.stopped(now_s):
                if meeting.have_filmed[index]:
                    logger.warning("camera %s has stopped", self._cameras[index].name)
                elif not self._said[index]:  # else it is said already why
                    logger.warning("camera %s: no frame came so far", self._cameras[index].name)
            ready: list[Instant] = []
            while (instant := meeting.take(now_s)) is not None:
                ready.append(instant)
            left_out = max(0, len(ready) - _MOST_WAITING)
            for position, instant in enumerate(ready[left_out:]):
                yield instant, left_out if position == 0 else 0
            if ready:
                wait_s = 0.0
            elif meeting.has_ended:
                return
            else:
                deadline_s = meeting.deadline_s()
                wait_s = _LOOK_S if deadline_s is None else min(max(0.001, deadline_s - now_s), _LOOK_S)

    def _track(self, instant: Instant, elapsed: int, outputs: list[RowsOutput]) -> None:
        count = len(self._cameras)
        images = np.zeros((count, *self._shape), np.uint8)
        for index, image in enumerate(instant.coverage):
            if image is not None:
                images[index, : image.shape[0], : image.shape[1]] = image
        is_there = np.array([image is not None for image in instant.coverage])
        exposures = Exposures(
            instant.offset_s.astype(np.float32), is_there, is_there.astype(np.float32), self._line_time_s
        )
        rows = self._run.step(instant.number, instant.time_s, images, exposures, num_frames=elapsed)
        for output in list(outputs):
            try:
                output.write(rows)
            except OutputError as error:
                outputs.remove(output)
                if not outputs:
                    raise
                logger.warning("%s; tracking goes on with the other outputs", error)
                self.result.failed_outputs.append(error)
        result = self.result
        result.instants += 1
        result.delay_s.append(time.monotonic() - instant.arrived_s)
        del result.delay_s[: -round(3600 * self._rate_hz)]
        result.drones.update(rows.drones)
        self._run.look_ahead()
        result.late_searches = self._run.num_late_searches


def _until_ready(connection: Connection) -> Iterator[Message]:
    """The messages of a worker up to `Ready`, such as that a source has failed. A worker that dies is noticed later."""
    with contextlib.suppress(EOFError, OSError):
        while not isinstance(message := connection.recv(), Ready):
            yield message

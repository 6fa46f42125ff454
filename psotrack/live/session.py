"""A session: a thread per camera makes silhouettes, the calling thread brings them together and tracks."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from psotrack.errors import InputError, PsotrackError
from psotrack.live.meeting import CameraCounts, Instant, Meeting
from psotrack.live.sources import CameraStream, LiveSource, ReplayedVideo
from psotrack.pipeline import CausalRun, causal_settings
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.silhouettes import (
    Exposures,
    LivingBackground,
    ScaledSettings,
    coverage,
    ignored_pixels,
    reduce_frame,
    usual_drone_px,
)
from psotrack.trajectories import Trajectories

logger = logging.getLogger(__name__)

#: How long an instant waits for cameras, seconds.
WAIT_S = 0.1
#: Largest number of complete instants that wait for the tracker: more are left out, so that the delay does not grow.
_MOST_WAITING = 3
#: A frame that waits for longer before it is processed is left out, seconds.
_MOST_BEHIND_S = 0.1
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
    """

    name: str
    source: LiveSource
    fps: float
    line_time_s: float = 0.0
    ignore: Path | None = None


@dataclass
class LiveResult:
    """What a session has done.

    Attributes:
        instants: number of instants that were tracked.
        left_out: number of instants that were left out, because the computer was too slow.
        delay_s: delay of each instant, from the arrival of its last frame to its rows; of the last hour at most.
        counts: counts of each camera, by name.
        drones: names of all drones.
        seconds: wall time.
    """

    instants: int = 0
    left_out: int = 0
    delay_s: list[float] = field(default_factory=list)
    counts: dict[str, CameraCounts] = field(default_factory=dict)
    drones: set[str] = field(default_factory=set)
    seconds: float = 0.0


def live_cameras(
    recording: Recording, *, replay: bool, speed: float = 1.0, loops: int = 1
) -> list[LiveCamera]:
    """The cameras of a recording that have a source of frames: streams and devices, or videos that are replayed.

    Raises:
        InputError: fewer than two cameras have a source.
    """
    found = []
    for index, name in enumerate(recording.rig.names):
        source: LiveSource
        if replay and name in recording.videos:
            times = recording.frame_times[name]
            source, fps = ReplayedVideo(recording.videos[name], times.time_s, speed, loops), times.fps
        elif not replay and name in recording.streams:
            address = recording.streams[name]
            size_wh = recording.rig.cameras.image_size_wh[index].astype(int).tolist()
            device = address.removeprefix("device ")
            source = CameraStream(int(device) if device.isdigit() else address, (size_wh[0], size_wh[1]))
            fps = recording.frame_times[name].fps if name in recording.frame_times else _USUAL_HZ
        else:
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
        wait_s: how long an instant waits for cameras, seconds of the wall clock.
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
    ) -> None:
        settings = causal_settings(settings)
        names = {each.name for each in cameras}
        self._rig = recording.rig.select([name for name in recording.rig.names if name in names])
        self._cameras = cameras
        sizes_wh = [(int(width), int(height)) for width, height in self._rig.cameras.image_size_wh]
        self._scaled = settings.silhouettes.scaled(sizes_wh, usual_drone_px(recording.rig))
        self._rate_hz = settings.rate_hz or max(each.fps for each in cameras)
        self._wait_s, self._first_s = wait_s, first_s
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
        self._stopped = threading.Event()
        self._changed = threading.Condition()
        self._failed: list[BaseException] = []
        self.result = LiveResult(counts={each.name: CameraCounts() for each in cameras})

    def compile(self) -> None:
        """Compile what no frame should wait for."""
        self._run.compile()

    def stop(self) -> None:
        """End the session after the present instant."""
        self._stopped.set()
        with self._changed:
            self._changed.notify_all()

    def run(
        self, outputs: list[RowsOutput], on_instant: Callable[[LiveResult, list[bool]], None] | None = None
    ) -> LiveResult:
        """Track until all sources have ended, or `stop` is called.

        Args:
            outputs: what takes the rows.
            on_instant: is told of the result so far, and which cameras film, after each instant.

        Raises:
            InputError: no source can bring frames.
            OutputError: an output fails.
        """
        began_s = time.monotonic()
        self._meeting = Meeting(
            [each.fps for each in self._cameras],
            self._rate_hz,
            wait_s=self._wait_s,
            began_s=began_s,
            first_s=self._first_s,
        )
        self.result.counts = dict(
            zip((each.name for each in self._cameras), self._meeting.counts, strict=True)
        )
        slots = threading.BoundedSemaphore(os.cpu_count() or 1)
        threads = [
            threading.Thread(target=self._film, args=(index, began_s, slots), daemon=True)
            for index in range(len(self._cameras))
        ]
        before, cv2_threads = None, cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            for thread in threads:
                thread.start()
            for instant, num_left_out in self._instants():
                elapsed = 1 if before is None else instant.number - before
                before = instant.number
                self._track(instant, elapsed, outputs)
                self.result.left_out += num_left_out
                self.result.seconds = time.monotonic() - began_s
                if on_instant is not None:
                    on_instant(self.result, self._meeting.films)
        finally:
            self.stop()
            for thread in threads:
                thread.join(timeout=2.0)
            cv2.setNumThreads(cv2_threads)
        if self._failed and not self.result.instants:
            raise self._failed[0]
        return self.result

    def _instants(self) -> Iterator[tuple[Instant, int]]:
        """Yield instants that are complete, and how many were left out before each."""
        while not self._stopped.is_set():
            ready: list[Instant] = []
            with self._changed:
                while not self._stopped.is_set():
                    now_s = time.monotonic()
                    for index in self._meeting.stopped(now_s):
                        logger.warning("camera %s has stopped", self._cameras[index].name)
                    while (instant := self._meeting.take(now_s)) is not None:
                        ready.append(instant)
                    if ready or self._meeting.has_ended:
                        break
                    deadline_s = self._meeting.deadline_s()
                    self._changed.wait(0.2 if deadline_s is None else max(0.001, deadline_s - now_s))
            if not ready:
                return
            left_out = max(0, len(ready) - _MOST_WAITING)
            for position, instant in enumerate(ready[left_out:]):
                yield instant, left_out if position == 0 else 0

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
        for output in outputs:
            output.write(rows)
        result = self.result
        result.instants += 1
        result.delay_s.append(time.monotonic() - instant.arrived_s)
        del result.delay_s[: -round(3600 * self._rate_hz)]
        result.drones.update(rows.drones)
        self._run.look_ahead()

    def _film(self, index: int, began_s: float, slots: threading.BoundedSemaphore) -> None:
        """The thread of a camera: frames to silhouettes."""
        camera = self._cameras[index]
        said = ""
        try:
            silhouettes = _Silhouettes(self._scaled, camera.ignore)
            frames = camera.source.frames(began_s, self._stopped.is_set)
            with contextlib.closing(frames):
                for frame in frames:
                    if isinstance(frame, str):
                        if frame != said:
                            logger.warning("camera %s: %s", camera.name, frame)
                        said = frame
                        continue
                    said = ""
                    with self._changed:
                        if self._meeting.announce(index, frame.time_s, time.monotonic()):
                            logger.warning("camera %s films again", camera.name)
                    with slots:
                        # A frame that has waited for long is left out, so that the delay does not grow.
                        is_late = time.monotonic() - frame.arrived_s > _MOST_BEHIND_S
                        image = None if frame.image is None or is_late else silhouettes.step(frame.image)
                    with self._changed:
                        if image is None:
                            silhouettes.num_left_out += 1
                            self._meeting.leave_out(index)
                        else:
                            self._meeting.put(index, frame.time_s, image, frame.arrived_s)
                        self._changed.notify_all()
        except PsotrackError as error:
            logger.warning("camera %s: %s", camera.name, error)
            self._failed.append(error)
        finally:
            with self._changed:
                self._meeting.end(index)
                self._changed.notify_all()


class _Silhouettes:
    """Silhouettes of one camera's frames, whose background is learned as they come."""

    def __init__(self, settings: ScaledSettings, ignore: Path | None) -> None:
        self._settings = settings
        self._ignore = ignore
        self._ignored: Bool[np.ndarray, "rows columns"] | None = None
        self._background: LivingBackground | None = None
        self.num_left_out = 0

    def step(self, frame: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "rows columns"]:
        """The silhouette of the next frame."""
        image = reduce_frame(frame, self._settings)
        if self._background is None:
            self._background = LivingBackground(self._settings, image)
            if self._ignore is not None:
                self._ignored = ignored_pixels(
                    self._ignore,
                    "the camera",
                    (frame.shape[1], frame.shape[0]),
                    self._settings.working_reduction,
                )
        mask = self._background.step(image, num_frames=1 + self.num_left_out)
        self.num_left_out = 0
        if self._ignored is not None:
            mask = np.where(self._ignored, np.uint8(0), mask)
        return coverage(mask, self._settings.reduction // self._settings.working_reduction)

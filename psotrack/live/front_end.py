"""The front end of a session: worker processes that turn the cameras' frames into silhouettes.

A worker has a thread for each of its cameras. It sends messages to the session. The session sends two: the time at
which the recording's clock shows 0, and None when the worker shall end. A worker ends also when the session's process
dies.
"""

from __future__ import annotations

import contextlib
import gc
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from psotrack.live.packed_image import PackedImage
from psotrack.live.recorder import CLOSE_S, CameraRecorder, RecordedCounts
from psotrack.live.sources import LiveSource
from psotrack.silhouettes import LivingBackground, ScaledSettings, coverage, ignored_pixels, reduce_frame
from psotrack.support import with_traceback

#: Longest time that a camera waits for the silhouettes of others before it learns, seconds.
_LONGEST_TURN_S = 0.02
#: Time that the cameras' threads have to end, seconds.
_END_S = 0.5


@dataclass(frozen=True)
class FilmTask:
    """One camera of a worker.

    Attributes:
        index: number of the camera in the session.
        source: source of its frames.
        settings: settings of the silhouettes.
        ignore: image that is white where nothing counts as foreground; None for no such image.
        most_behind_s: a frame that has waited for longer is left out, so that the delay does not grow, seconds.
        recorder: keeps the frames; None where they are not kept.
    """

    index: int
    source: LiveSource
    settings: ScaledSettings
    ignore: Path | None
    most_behind_s: float
    recorder: CameraRecorder | None = None


@dataclass(frozen=True)
class Ready:
    """A worker waits for the time at which the recording's clock shows 0."""


@dataclass(frozen=True)
class Arrived:
    """A frame has come, and is in work.

    Attributes:
        camera: number of the camera.
        time_s: when the frame was filmed, on the recording's clock, seconds.
    """

    camera: int
    time_s: float


@dataclass(frozen=True)
class CameraSilhouette:
    """The silhouette of the frame that has come.

    Attributes:
        camera: number of the camera.
        time_s: when the frame was filmed, on the recording's clock, seconds.
        arrived_s: when the frame came, `time.monotonic`.
        coverage: the silhouette; None for a frame that was left out, because the program is behind.
    """

    camera: int
    time_s: float
    arrived_s: float
    coverage: PackedImage | None


@dataclass(frozen=True)
class Notice:
    """A line of text about a camera, such as that the stream has broken off.

    Attributes:
        camera: number of the camera.
        line: the text.
    """

    camera: int
    line: str


@dataclass(frozen=True)
class Ended:
    """A camera has ended for good.

    Attributes:
        camera: number of the camera.
        error: why; None where the source has no more frames.
    """

    camera: int
    error: BaseException | None


@dataclass(frozen=True)
class RecordingNotice:
    """A line of text about the recording of the frames.

    Attributes:
        line: the text.
    """

    line: str


@dataclass(frozen=True)
class FilesFinished:
    """The files of a camera's recording are finished.

    Attributes:
        camera: number of the camera.
        counts: what happened to its frames.
    """

    camera: int
    counts: RecordedCounts


Message = Ready | Arrived | CameraSilhouette | Notice | Ended | RecordingNotice | FilesFinished


def film(tasks: Sequence[FilmTask], connection: Connection) -> None:
    """Run a worker: send `Ready`, receive the time of the clock's 0, and send the messages of all cameras."""
    sending, stopped = threading.Lock(), threading.Event()

    def send(message: Message) -> None:
        try:
            with sending:
                connection.send(message)
        except OSError:  # the session has ended
            stopped.set()

    turns, start = _Turns(), _Start(len(tasks))
    threads = [
        threading.Thread(target=_film_one, args=(task, start, stopped, send, turns), daemon=True)
        for task in tasks
    ]
    for thread in threads:
        thread.start()
    start.wait_for_sources()
    # What was imported and made so far is not searched for garbage again and again.
    gc.freeze()
    send(Ready())
    with contextlib.suppress(EOFError, OSError):  # the session's process has died
        start.give(connection.recv())
        connection.recv()
    stopped.set()
    start.give(0.0)
    end_s = time.monotonic() + _END_S
    for thread in threads:
        thread.join(max(0.0, end_s - time.monotonic()))
    recorders = {task.index: task.recorder for task in tasks if task.recorder is not None}
    for recorder in recorders.values():
        recorder.finish()
    end_s = time.monotonic() + CLOSE_S
    for index, recorder in recorders.items():
        send(FilesFinished(index, recorder.close(max(0.0, end_s - time.monotonic()))))
        if recorder.loss is not None:
            send(RecordingNotice(recorder.loss))


def _film_one(
    task: FilmTask,
    start: _Start,
    stopped: threading.Event,
    send: Callable[[Message], None],
    turns: _Turns,
) -> None:
    """The thread of a camera: frames to silhouettes."""
    error: BaseException | None = None
    try:
        _Silhouettes(task.settings, None).warm_up()
        silhouettes = _Silhouettes(task.settings, task.ignore)
        with contextlib.closing(task.source.frames(start.begin, stopped.is_set)) as frames:
            for frame in frames:
                if isinstance(frame, str):
                    send(Notice(task.index, frame))
                    continue
                send(Arrived(task.index, frame.time_s))
                image = frame.image
                if image is None or time.monotonic() - frame.arrived_s > task.most_behind_s:
                    silhouettes.leave_out()
                    send(CameraSilhouette(task.index, frame.time_s, frame.arrived_s, None))
                else:
                    with turns.of_frame():
                        silhouette = PackedImage.of(silhouettes.look(image))
                        send(CameraSilhouette(task.index, frame.time_s, frame.arrived_s, silhouette))
                    # What the tracker does not wait for.
                    turns.wait()
                    silhouettes.learn()
                if task.recorder is not None and (line := task.recorder.write(image, frame.time_s)):
                    send(RecordingNotice(line))
    except Exception as failed:
        error = with_traceback(failed)
    finally:
        send(Ended(task.index, error))
        start.leave()


class _Start:
    """The cameras of a worker begin together, when all of them are ready."""

    def __init__(self, num_sources: int) -> None:
        self._ready = threading.Semaphore(0)
        self._num_sources = num_sources
        self._given = threading.Event()
        self._began_s = 0.0
        self._of_thread = threading.local()

    def begin(self) -> float:
        """The source is ready; wait for the time at which the recording's clock showed 0."""
        self.leave()
        self._given.wait()
        return self._began_s

    def leave(self) -> None:
        """Do not wait for the source of this thread any more."""
        if not getattr(self._of_thread, "has_left", False):
            self._of_thread.has_left = True
            self._ready.release()

    def wait_for_sources(self) -> None:
        """Wait until all sources are ready or have ended."""
        for _ in range(self._num_sources):
            self._ready.acquire()

    def give(self, began_s: float) -> None:
        """Let the sources begin."""
        if not self._given.is_set():
            self._began_s = began_s
            self._given.set()


class _Turns:
    """The cameras of a worker: no camera learns while another one's silhouette is in work."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._num_in_work = 0

    @contextlib.contextmanager
    def of_frame(self) -> Iterator[None]:
        """A silhouette is in work."""
        with self._changed:
            self._num_in_work += 1
        try:
            yield
        finally:
            with self._changed:
                self._num_in_work -= 1
                self._changed.notify_all()

    def wait(self) -> None:
        """Wait until no silhouette is in work, but not for long: the next frame comes."""
        with self._changed:
            self._changed.wait_for(lambda: not self._num_in_work, _LONGEST_TURN_S)


class _Silhouettes:
    """Silhouettes of one camera's frames, whose background is learned as they come."""

    def __init__(self, settings: ScaledSettings, ignore: Path | None) -> None:
        self._settings = settings
        self._ignore = ignore
        self._ignored: Bool[np.ndarray, "rows columns"] | None = None
        self._background: LivingBackground | None = None
        self._num_left_out = 0

    def leave_out(self) -> None:
        """The next frame is not seen."""
        self._num_left_out += 1

    def look(self, frame: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "rows columns"]:
        """The silhouette of the next frame; `learn` is to be called before the frame after it."""
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
        mask = self._background.look(image, num_frames=1 + self._num_left_out)
        self._num_left_out = 0
        if self._ignored is not None:
            mask = np.where(self._ignored, np.uint8(0), mask)
        return coverage(mask, self._settings.reduction // self._settings.working_reduction)

    def warm_up(self) -> None:
        """Do once what is slow the first time."""
        for level in (0, 9):
            self.look(np.full((270, 480, 3), level, np.uint8))
            self.learn()

    def learn(self) -> None:
        """Learn from the last frame."""
        assert self._background is not None
        self._background.learn()

"""The front end of a session: worker processes that turn the cameras' frames into silhouettes.

A worker has a thread for each of its cameras. It sends messages to the session. The session sends two: the time at
which the recording's clock shows 0, and None when the worker shall end. A worker ends also when the session's process
dies.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from psotrack.live.sources import LiveSource
from psotrack.silhouettes import LivingBackground, ScaledSettings, coverage, ignored_pixels, reduce_frame
from psotrack.support import with_traceback

#: A frame that waits for longer before it is processed is left out, seconds.
_MOST_BEHIND_S = 0.1
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
    """

    index: int
    source: LiveSource
    settings: ScaledSettings
    ignore: Path | None


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
    coverage: UInt8[np.ndarray, "rows columns"] | None


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


Message = Ready | Arrived | CameraSilhouette | Notice | Ended


def film(tasks: Sequence[FilmTask], connection: Connection) -> None:
    """Run a worker: send `Ready`, receive the time of the clock's 0, and send the messages of all cameras."""
    sending, stopped = threading.Lock(), threading.Event()

    def send(message: Message) -> None:
        try:
            with sending:
                connection.send(message)
        except OSError:  # the session has ended
            stopped.set()

    send(Ready())
    began_s = connection.recv()
    turns = _Turns()
    threads = [
        threading.Thread(target=_film_one, args=(task, began_s, stopped, send, turns), daemon=True)
        for task in tasks
    ]
    for thread in threads:
        thread.start()
    with contextlib.suppress(EOFError, OSError):  # the session's process has died
        connection.recv()
    stopped.set()
    end_s = time.monotonic() + _END_S
    for thread in threads:
        thread.join(max(0.0, end_s - time.monotonic()))


def _film_one(
    task: FilmTask, began_s: float, stopped: threading.Event, send: Callable[[Message], None], turns: _Turns
) -> None:
    """The thread of a camera: frames to silhouettes."""
    error: BaseException | None = None
    try:
        silhouettes = _Silhouettes(task.settings, task.ignore)
        with contextlib.closing(task.source.frames(began_s, stopped.is_set)) as frames:
            for frame in frames:
                if isinstance(frame, str):
                    send(Notice(task.index, frame))
                    continue
                send(Arrived(task.index, frame.time_s))
                # A frame that has waited for long is left out, so that the delay does not grow.
                if frame.image is None or time.monotonic() - frame.arrived_s > _MOST_BEHIND_S:
                    silhouettes.leave_out()
                    send(CameraSilhouette(task.index, frame.time_s, frame.arrived_s, None))
                    continue
                with turns.of_frame():
                    silhouette = silhouettes.look(frame.image)
                    send(CameraSilhouette(task.index, frame.time_s, frame.arrived_s, silhouette))
                # What the tracker does not wait for.
                turns.wait()
                silhouettes.learn()
    except Exception as failed:
        error = with_traceback(failed)
    finally:
        send(Ended(task.index, error))


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

    def learn(self) -> None:
        """Learn from the last frame."""
        assert self._background is not None
        self._background.learn()

"""Keeps what live cameras film, as a recording that can be tracked again.

Each camera gets a video, MPEG-4 in an AVI file, and a file of its frames' times. A frame is encoded in a thread of its
own with a lower priority, after its silhouette was made. What cannot be encoded in time is left out of the recording
and counted, so that tracking never waits. A video whose program is killed can be read up to its last complete frame.
"""

from __future__ import annotations

import contextlib
import os
import queue
import shutil
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings import (
    RECORDING_FILE,
    CameraTable,
    MarkersTable,
    Recording,
    RecordingFile,
    VideoEncoder,
    WorldTable,
    probe,
    write_recording_file,
)
from psotrack.rig_files import write_rig
from psotrack.support import check_file_name

#: MPEG-4 part 2, which all wheels of OpenCV can write. A frame of 1920 x 1080, textured with a little noise, took 6.0
#: ms of one thread and 34 kB, and 1.5 ms to decode. MJPEG took 11 ms and 309 kB, VP8 109 ms, FFV1 74 ms and 3.1 MB. Of
#: a killed program's AVI file all but the last 32 KiB is there; Matroska lost up to 5 MB.
_CODEC, _SUFFIX = "XVID", ".avi"
#: Largest number of frames of a camera that wait to be encoded: 6 MB each at 1920 x 1080.
_MOST_WAITING = 8
#: Lower priority of the threads that encode, as `nice` counts it: tracking comes first.
_NICE = 10
#: Free space at which recording ends, bytes: the videos' indices, the times and the tracks need room too.
_LEAST_FREE_BYTES = 256 * 10**6
#: How often the disk is looked at, seconds.
_LOOK_S = 1.0
#: FFmpeg holds back this number of bytes before it writes.
_HELD_BACK = 2**15
#: Largest time that a camera's last frames may take to be encoded, seconds.
CLOSE_S = 5.0


@dataclass
class RecordedCounts:
    """What happened to a camera's frames in its recording.

    Attributes:
        frames: frames that were recorded.
        left_out: different frames that were not recorded, because the computer was too slow or the disk was full.
    """

    frames: int = 0
    left_out: int = 0


class CameraRecorder:
    """Writes the frames of one camera, and their times. It can be pickled until the first frame is written.

    Args:
        folder: existing folder of the recording.
        name: name of the camera, and of its files.
        fps: frames per second that the video states; the file of times is exact.
        image_size_wh: width and height of the frames, even numbers, pixels.
        least_free_bytes: free space of the disk at which recording ends.

    Attributes:
        counts: what happened to the frames, complete when the recorder is closed.
        video, times: paths of the video and of the file of times.
        loss: a line of text where frames that were handed over did not reach the disk, which only `close` finds out;
            else None.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        fps: float,
        image_size_wh: tuple[int, int],
        *,
        least_free_bytes: int = _LEAST_FREE_BYTES,
    ) -> None:
        self.folder, self.name, self.fps, self.image_size_wh = folder, name, fps, image_size_wh
        self.least_free_bytes = least_free_bytes
        check_file_name(name, "cameras")
        self.video, self.times = folder / f"{name}{_SUFFIX}", folder / f"{name}_times.csv"
        self.counts = RecordedCounts()
        self.loss: str | None = None
        self._encoder: _Encoder | None = None
        self._said: set[str] = set()
        self._last_s = -np.inf
        self._is_finished = False

    def write(self, image: UInt8[np.ndarray, "height width 3"] | None, time_s: float) -> str | None:
        """Hand over the next frame; does not wait. The image must not be changed afterwards.

        Args:
            image: BGR; None for a frame that was not decoded, because the computer is too slow.
            time_s: when it was filmed, on the recording's clock, seconds.

        Returns:
            A line of text, once, where the recording leaves out frames or has ended.
        """
        if self._is_finished or time_s <= self._last_s:  # the same frame again
            return None
        self._last_s = time_s
        if self._encoder is None:
            self._encoder = _Encoder(self)
        said = self._encoder.put(image, time_s)
        self.counts.left_out += said is not None
        if said is None or said in self._said:
            return None
        self._said.add(said)
        return said

    def finish(self) -> None:
        """Take no more frames; does not wait for those that are being encoded."""
        if self._encoder is not None and not self._is_finished:
            self._encoder.finish()
        self._is_finished = True

    def close(self, wait_s: float = CLOSE_S) -> RecordedCounts:
        """Finish the files; the frames that wait are encoded first.

        Args:
            wait_s: longest time that this may take, seconds; then what has reached the disk counts.
        """
        self.finish()
        encoder, self._encoder = self._encoder, None
        if encoder is not None:
            encoder.join(wait_s)
            # Counted in the file: FFmpeg does not report what did not reach the disk.
            self.counts.frames = min(encoder.num_encoded, readable_frames(self.video))
            num_lost = encoder.num_taken - self.counts.frames
            self.counts.left_out += num_lost
            if num_lost and encoder.failure is None:
                self.loss = (
                    f"{self.video}: expected {encoder.num_taken} frames, found {self.counts.frames}; "
                    "is the disk full, or too slow?"
                )
        return self.counts


class _Encoder:
    """The thread that encodes the frames of a camera.

    Attributes:
        num_taken: number of different frames that were handed over.
        num_encoded: number of them that were encoded.
        failure: why recording has ended early, a line of text; None where it has not.
    """

    def __init__(self, recorder: CameraRecorder) -> None:
        self._recorder = recorder
        self._waiting: queue.SimpleQueue[tuple[np.ndarray, float] | None] = queue.SimpleQueue()
        self.failure: str | None = None
        width, height = recorder.image_size_wh
        # Each block of 16 x 16 pixels takes at least a bit, and a frame two headers of together 15 bytes.
        self._least_bytes = (-(-width // 16) * -(-height // 16)) // 8 + 15
        self._size, self._num_since, self._looked_s = 0, 0, -np.inf
        self.num_taken = self.num_encoded = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def put(self, image: np.ndarray | None, time_s: float) -> str | None:
        """Let a frame wait to be encoded; return why it is left out."""
        if self.failure is not None:
            return self.failure
        if image is None or self._waiting.qsize() >= _MOST_WAITING:
            return f"{self._recorder.folder}: frames are left out of the recording, because the computer is too slow"
        self._waiting.put((image, time_s))
        self.num_taken += 1
        return None

    def finish(self) -> None:
        self._waiting.put(None)

    def join(self, wait_s: float) -> None:
        self._thread.join(wait_s)

    def _run(self) -> None:
        recorder = self._recorder
        _lower_priority()
        try:
            with recorder.times.open("w", encoding="utf-8", newline="") as times:
                times.write("frame,time_s\n")
                encoder = VideoEncoder(recorder.video, _CODEC, recorder.fps, recorder.image_size_wh)
                try:
                    while (frame := self._waiting.get()) is not None:
                        self._look_at_disk()
                        self._encode(encoder, times, *frame)
                finally:
                    encoder.close()
        except OSError as error:
            found = error.strerror.lower() if error.strerror else f"{error}"
            self.failure = (
                f"{recorder.folder}: expected to record, found {found}; "
                "what was recorded before stays, tracking goes on"
            )

    def _encode(self, encoder: VideoEncoder, times: TextIO, image: np.ndarray, time_s: float) -> None:
        recorder = self._recorder
        if image.shape[1::-1] != recorder.image_size_wh:
            width, height = recorder.image_size_wh
            raise OSError(f"images of camera {recorder.name} that do not have {width} x {height} pixels")
        # The row first: if the program is killed, times without a frame are left aside when the recording is opened.
        times.write(f"{self.num_encoded},{time_s!r}\n")
        times.flush()
        encoder.write(image)
        self.num_encoded += 1
        self._num_since += 1

    def _look_at_disk(self) -> None:
        """Raise `OSError` where the disk is nearly full, or frames do not reach it, which FFmpeg does not report."""
        if time.monotonic() - self._looked_s < _LOOK_S:
            return
        self._looked_s = time.monotonic()
        least = self._recorder.least_free_bytes
        if shutil.disk_usage(self._recorder.folder).free < least:
            raise OSError(f"less than {least // 10**6} MB of free disk space")
        size = self._recorder.video.stat().st_size
        if size > self._size:
            self._size, self._num_since = size, 0
        elif self._num_since * self._least_bytes > 2 * _HELD_BACK:
            raise OSError("that the video does not grow any more; is the disk full?")


def readable_frames(video: Path) -> int:
    """Number of frames of a recorded video; 0 for a file that is none."""
    try:
        return probe(video).num_frames
    except InputError:
        return 0


def _lower_priority() -> None:
    """Give the calling thread a lower priority, where threads have one of their own."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)


class RecordingFolder:
    """The folder of a recording that is made while the cameras film.

    Args:
        folder: the folder; it is created.
        recording: the rig, and what is known of its cameras.
        names: names of the cameras that are recorded.
        force: write into a folder that is not empty.

    Raises:
        OutputError: the folder is not empty and `force` is not set, or it cannot be written.
        SettingsError: it is the folder of the recording that names the cameras, or the images of a camera have an odd
            size.
    """

    def __init__(
        self, folder: Path, recording: Recording, names: Sequence[str], *, force: bool = False
    ) -> None:
        self._folder, self._recording = folder, recording
        self._names = [name for name in recording.rig.names if name in names]
        if folder.resolve() == recording.folder.resolve():
            raise SettingsError(
                "--record", expected="another folder", found="that of the cameras' recording.toml"
            )
        self._sizes_wh = {
            name: (int(width), int(height))
            for name, (width, height) in zip(
                recording.rig.names, recording.rig.cameras.image_size_wh, strict=True
            )
        }
        for name in self._names:
            width, height = self._sizes_wh[name]
            if width % 2 or height % 2:
                raise SettingsError(
                    "--record",
                    expected="images with even numbers of pixels, because the codec halves the resolution of colours",
                    found=f"{width} x {height} of camera {name}",
                )
        if folder.exists() and not folder.is_dir():
            raise OutputError(folder, expected="a folder", found="a file")
        if not force and folder.is_dir() and any(folder.iterdir()):
            raise OutputError(
                folder,
                expected="a new or an empty folder",
                found="a folder with files",
                remedy="pass --force to replace an earlier recording in it",
            )

    def recorder(self, name: str, fps: float) -> CameraRecorder:
        """The recorder of a camera."""
        return CameraRecorder(self._folder, name, fps, self._sizes_wh[name])

    def begin(self) -> None:
        """Write the rig, the images of what is ignored, and a recording.toml with all cameras.

        Raises:
            OutputError: the folder cannot be written.
        """
        recording = self._recording
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            for name in self._names:
                recorder = self.recorder(name, 1.0)
                # Otherwise the files of an earlier recording would be taken for those of a camera that stays silent.
                recorder.video.unlink(missing_ok=True)
                recorder.times.unlink(missing_ok=True)
                if name in recording.ignore:
                    shutil.copyfile(recording.ignore[name], self._folder / self._ignore_name(name))
            if recording.marker_corners is not None:
                shutil.copyfile(recording.marker_corners, self._folder / recording.marker_corners.name)
        except OSError as error:
            raise OutputError(
                self._folder, expected="a folder that can be written", found=error.strerror or f"{error}"
            ) from error
        write_rig(self._folder / "rig.toml", recording.rig.select(self._names), force=True)
        self._write(self._names)

    def end(self) -> None:
        """Leave cameras out of the recording.toml that have no two frames; where no camera has, remove all files.

        Raises:
            OutputError: the recording.toml cannot be written; then it still names all cameras.
        """
        there = [name for name in self._names if readable_frames(self.recorder(name, 1.0).video) >= 2]
        if not there:
            self._remove()
        elif there != self._names:
            self._write(there)

    def _remove(self) -> None:
        """Remove what was written, so that the folder can be used again."""
        recording = self._recording
        files = ["rig.toml", RECORDING_FILE, *map(self._ignore_name, recording.ignore)]
        if recording.marker_corners is not None:
            files.append(recording.marker_corners.name)
        for name in self._names:
            recorder = self.recorder(name, 1.0)
            files += [recorder.video.name, recorder.times.name]
        with contextlib.suppress(OSError):
            for file in files:
                (self._folder / file).unlink(missing_ok=True)
            self._folder.rmdir()

    def _write(self, names: Sequence[str]) -> None:
        recording = self._recording
        bounds_m = recording.bounds_m
        low_m, high_m = (None, None) if bounds_m is None else (bounds_m[0::2], bounds_m[1::2])
        content = RecordingFile(
            version=1,
            calibration="rig.toml",
            cameras={name: self._table(name) for name in names},
            world=WorldTable() if bounds_m is None else WorldTable(bounds_m=(low_m, high_m)),  # type: ignore[arg-type]
            markers=None
            if recording.marker_corners is None
            else MarkersTable(corners=recording.marker_corners.name),
        )
        write_recording_file(self._folder / RECORDING_FILE, content)

    def _table(self, name: str) -> CameraTable:
        recorder = self.recorder(name, 1.0)
        return CameraTable(
            video=recorder.video.name,
            timestamps=recorder.times.name,
            ignore=self._ignore_name(name) if name in self._recording.ignore else None,
            line_time_s=self._recording.line_time_s.get(name, 0.0),
        )

    def _ignore_name(self, name: str) -> str:
        return f"{name}_ignore{self._recording.ignore[name].suffix}"

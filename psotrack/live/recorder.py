"""Keeps what live cameras film, as a recording that can be tracked again.

Each camera gets a video, MPEG-4 in an AVI file, and a file of its frames' times. A frame is encoded in a thread of its
own with a lower priority, after its silhouette was made. What cannot be encoded in time is left out of the recording
and counted, so that tracking never waits. A video whose program is killed can be read up to its last complete frame.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import queue
import shutil
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError, OutputError, SettingsError, system_errors
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import (
    RECORDING_FILE,
    CameraRecording,
    CameraTable,
    Recording,
    RecordingFile,
    VideoEncoder,
    WorldTable,
    probe,
    write_recording_file,
)
from psotrack.support import check_file_name

logger = logging.getLogger(__name__)

#: MPEG-4 part 2, which all wheels of OpenCV can write. A frame of 1920 x 1080, textured with a little noise, took 6.0
#: ms of one thread and 34 kB, and 1.5 ms to decode. MJPEG took 11 ms and 309 kB, VP8 109 ms, FFV1 74 ms and 3.1 MB. Of
#: a killed program's AVI file all but the last 32 KiB is there; Matroska lost up to 5 MB.
_CODEC = "XVID"
_RIG_FILE = "rig.toml"
#: Largest number of frames of a camera that wait to be encoded: 6 MB each at 1920 x 1080.
_MOST_WAITING = 8
#: Lower priority of the threads that encode, as `nice` counts it: tracking comes first.
_NICE = 10
#: Free space at which recording ends, bytes: the videos' indices, the times and the tracks need room too.
_LEAST_FREE_BYTES = 256 * 10**6
#: Largest time that a camera's last frames may take to be encoded, seconds.
CLOSE_S = 5.0


@dataclass(frozen=True)
class RecordedCounts:
    """What happened to a camera's frames in its recording.

    Attributes:
        frames: frames that were recorded.
        left_out: different frames that were not recorded, because the computer was too slow or the disk was full.
    """

    frames: int = 0
    left_out: int = 0


class CameraRecorder:
    """Writes the frames of one camera, and their times, in a thread that the first frame starts.

    Args:
        folder: existing folder of the recording.
        name: name of the camera, and of its files.
        fps: frames per second that the video states; the file of times is exact.
        least_free_bytes: free space of the disk at which recording ends.

    Attributes:
        video, times: paths of the video and of the file of times.
    """

    def __init__(
        self, folder: Path, name: str, fps: float, *, least_free_bytes: int = _LEAST_FREE_BYTES
    ) -> None:
        self._folder, self._fps, self._least_free_bytes = folder, fps, least_free_bytes
        self.video, self.times = (folder / file for file in _files_of(name))
        self._num_frames, self._num_taken, self._last_s = 0, 0, -np.inf
        self._is_late = self._has_failed = False

    def write(self, image: UInt8[np.ndarray, "height width 3"], time_s: float) -> None:
        """Hand over the next frame; does not wait. Where the recording leaves out frames or ends, a line says so, once.

        Args:
            image: BGR, with even numbers of pixels; must not be changed afterwards.
            time_s: when it was filmed, on the recording's clock, seconds.
        """
        if time_s <= self._last_s:  # the same frame again
            return
        self._last_s = time_s
        if not self._num_frames:
            # Not before: a recorder is sent to the process of its camera.
            self._waiting: queue.SimpleQueue[tuple[np.ndarray, float] | None] = queue.SimpleQueue()
            self._thread = threading.Thread(target=self._encode, args=image.shape[1::-1], daemon=True)
            self._thread.start()
        self._num_frames += 1
        if not self._has_failed and self._waiting.qsize() < _MOST_WAITING:
            self._num_taken += 1
            self._waiting.put((image, time_s))
        elif not (self._has_failed or self._is_late):
            self._is_late = True
            text = "%s: frames are left out of the recording, because the computer is too slow"
            logger.warning(text, self._folder)

    def close(self) -> RecordedCounts:
        """Finish the files, for some seconds at most; the frames that wait are encoded first."""
        if not self._num_frames:
            return RecordedCounts()
        self._waiting.put(None)
        self._thread.join(CLOSE_S)
        # Counted in the file: FFmpeg does not report what did not reach the disk.
        found = _readable_frames(self.video)
        if found < self._num_taken and not self._has_failed:
            text = "%s: expected %d frames, found %d; is the disk full, or too slow?"
            logger.warning(text, self.video, self._num_taken, found)
        return RecordedCounts(found, self._num_frames - found)

    def _encode(self, width: int, height: int) -> None:
        if sys.platform == "linux":  # where threads have priorities of their own
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        try:
            encoder = VideoEncoder(self.video, _CODEC, self._fps, (width, height))
            with self.times.open("w", encoding="utf-8", newline="") as times, contextlib.closing(encoder):
                times.write("frame,time_s\n")
                for image, time_s in iter(self._waiting.get, None):
                    if shutil.disk_usage(self._folder).free < self._least_free_bytes:
                        raise OSError(f"less than {self._least_free_bytes // 10**6} MB of free disk space")
                    # The row first: if the program is killed, times without a frame are left aside when the recording
                    # is opened.
                    times.write(f"{encoder.num_frames},{time_s!r}\n")
                    times.flush()
                    encoder.write(image)
        except OSError as error:
            self._has_failed = True
            found = error.strerror.lower() if error.strerror else f"{error}"
            text = "%s: expected to record, found %s; what was recorded before stays, tracking goes on"
            logger.warning(text, self._folder, found)


def _files_of(name: str) -> tuple[str, str]:
    """Names of the video and of the file of times of a camera."""
    check_file_name(name, "cameras")
    return f"{name}.avi", f"{name}_times.csv"


def _readable_frames(video: Path) -> int:
    """Number of frames of a recorded video; 0 for a file that is none."""
    try:
        return probe(video).num_frames
    except InputError:
        return 0


@contextlib.contextmanager
def recording_folder(
    folder: Path, recording: Recording, names: Sequence[str], *, force: bool = False
) -> Iterator[None]:
    """Write what belongs to a recording beside videos and times, which cameras make during the block.

    At its beginning the folder gets the rig, the images of what is ignored, and a recording.toml with all cameras. At
    its end cameras without two frames are left out of the recording.toml; where no camera has two, nothing stays.

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
    rig = recording.rig.select(names)
    _check_folder(folder, recording, force)
    for name, (width, height) in zip(names, rig.cameras.image_size_wh.astype(int).tolist(), strict=True):
        if width % 2 or height % 2:
            expected = "images with even numbers of pixels, as the codec halves the resolution of colours"
            raise SettingsError("--record", expected=expected, found=f"{width} x {height} of camera {name}")
    tables = {name: _table(recording.by_name[name]) for name in names}
    with system_errors(folder, "a folder that can be written", OutputError):
        folder.mkdir(parents=True, exist_ok=True)
        # Otherwise the files of an earlier recording would be taken for those of a camera that stays silent.
        _remove_files(folder, tables)
        for name, table in tables.items():
            ignore = recording.by_name[name].ignore
            if ignore is not None:
                shutil.copyfile(ignore, folder / f"{table.ignore}")
    write_rig(folder / _RIG_FILE, rig, force=True)
    _write_tables(folder, tables, recording)
    try:
        yield
    finally:
        there = {
            name: table for name, table in tables.items() if _readable_frames(folder / f"{table.video}") >= 2
        }
        if there:
            _write_tables(folder, there, recording)
        else:
            _remove_files(folder, tables)


def _check_folder(folder: Path, recording: Recording, force: bool) -> None:
    if folder.resolve() == recording.folder.resolve():
        raise SettingsError(
            "--record", expected="another folder", found="that of the cameras' recording.toml"
        )
    if not force and folder.is_dir() and any(folder.iterdir()):
        expected, found = "a new or an empty folder", "a folder with files"
        remedy = "pass --force to replace an earlier recording in it"
        raise OutputError(folder, expected=expected, found=found, remedy=remedy)


def _table(camera: CameraRecording) -> CameraTable:
    video, times = _files_of(camera.name)
    copied = None if camera.ignore is None else f"{camera.name}_ignore{camera.ignore.suffix}"
    return CameraTable(video=video, timestamps=times, ignore=copied, line_time_s=camera.line_time_s)


def _remove_files(folder: Path, tables: Mapping[str, CameraTable]) -> None:
    """Remove the files of a recording."""
    of_cameras = [(each.video, each.timestamps, each.ignore) for each in tables.values()]
    for file in (_RIG_FILE, RECORDING_FILE, *itertools.chain(*of_cameras)):
        if file is not None:
            (folder / f"{file}").unlink(missing_ok=True)


def _write_tables(folder: Path, tables: Mapping[str, CameraTable], recording: Recording) -> None:
    bounds_m = recording.bounds_m
    world = WorldTable() if bounds_m is None else WorldTable(bounds_m=(bounds_m[0::2], bounds_m[1::2]))
    content = RecordingFile(version=1, calibration=_RIG_FILE, cameras=tables, world=world)
    write_recording_file(folder / RECORDING_FILE, content)

"""Segments: consecutive frames of one camera with their video, masks and detections, each drawn by one process.

A segment's folder is either complete or absent. A segment depends only on the scene and its frame numbers, so neither
the number of processes nor an interruption changes the joined files.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from psotrack.errors import OutputError
from psotrack.recordings import Detections, VideoWriter, join_videos, write_detections
from psotrack.recordings.datasets import DETECTIONS, MASKS, MaskWriter, join_archives
from psotrack.simulation.imaging.onboard import OnboardRenderer
from psotrack.simulation.imaging.renderer import CameraRenderer
from psotrack.simulation.labels.detector import detect
from psotrack.simulation.labels.masks import Silhouette, lens_silhouettes, silhouettes
from psotrack.simulation.scene import Scene
from psotrack.support import Advance, atomic_write

#: Time that a call waits for the lock, seconds: enough to try again where another call has just removed the lock file.
_LOCK_TIMEOUT_S = 0.2
#: Errors of file systems without locks. Two calls at once are not prevented there.
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP}


@contextlib.contextmanager
def unfinished(target: Path, record: bytes) -> Iterator[Path]:
    """Folder of the segments that calls with the same record have drawn; it is locked, and removed after the block.

    If the block raises, or the process is killed, the segments stay for the next call.

    Args:
        target: folder of the sequence, beside which the hidden folder is.
        record: everything that decides the content of the sequence.

    Raises:
        OutputError: another call is making the sequence, or the folder of the sequence cannot be written.
    """
    hidden = target.with_name(f".{target.name}.unfinished")
    # A worker that outlives its killed parent for a moment must not leave a segment to a sequence with another record.
    segments = hidden / hashlib.sha256(record).hexdigest()[:16]
    with _locked(target):
        for other in hidden.glob("*"):
            if other != segments:
                shutil.rmtree(other, ignore_errors=True)
        yield segments
        shutil.rmtree(hidden, ignore_errors=True)


@contextlib.contextmanager
def _locked(target: Path) -> Iterator[None]:
    """Lock a sequence. The lock ends with the process, even if the process is killed."""
    lock_file = target.with_name(f".{target.name}.lock")
    lock = FileLock(lock_file)
    try:
        lock_file.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=_LOCK_TIMEOUT_S, poll_interval=_LOCK_TIMEOUT_S / 10)
    except Timeout:
        expected = "no other simulation of this sequence at the same time"
        remedy = "wait until it ends, or choose another folder"
        raise OutputError(target, expected=expected, found="another simulation", remedy=remedy) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            found = error.strerror or str(error)
            raise OutputError(target, expected="a path that can be written", found=found) from error
    try:
        yield
    finally:
        # `FileLock` refuses a lock on a removed file, so it is safe to remove the file before the release. Windows
        # cannot remove an open file; `release` removes it there.
        with contextlib.suppress(OSError):
            lock_file.unlink()
        lock.release()


#: Frames per segment: ten groups of pictures of the codec. An interruption costs at most one segment per process,
#: about ten seconds of work.
SEGMENT_FRAMES = 120
_VIDEO, _BOXES, _MASKS = "video.avi", "detections.csv", "masks.zip"


@dataclass(frozen=True)
class Stream:
    """The images of one camera over time.

    Attributes:
        name: beginning of the names of the camera's files.
        index: index of the static camera, or of the drone that carries the camera.
        onboard: whether the camera is on board of a drone.
    """

    name: str
    index: int
    onboard: bool = False

    @property
    def video_file(self) -> str:
        """File name of the stream's video."""
        return f"{self.name}_s.avi"


@dataclass(frozen=True)
class Work:
    """Segments of one stream that one process draws, one after the other.

    Attributes:
        scene: the scene to draw.
        stream: the camera's stream.
        masks: whether to write the drones' masks.
        folder: folder of the stream's segments.
        segments: frame numbers of each segment.
    """

    scene: Scene
    stream: Stream
    masks: bool
    folder: Path
    segments: tuple[range, ...]


def segments(num_frames: int) -> list[range]:
    """Frame numbers of each segment."""
    starts = range(0, num_frames, SEGMENT_FRAMES)
    return [range(start, min(start + SEGMENT_FRAMES, num_frames)) for start in starts]


def segment_folder(folder: Path, frames: range) -> Path:
    """Folder of a complete segment, inside the folder of its stream's segments."""
    return folder / f"{frames.start:06d}"


def draw(work: Work, advance: Advance) -> None:
    """Draw the segments of one piece of work; `advance` counts frames."""
    scene, stream = work.scene, work.stream
    artist = OnboardRenderer(scene, stream.index) if stream.onboard else CameraRenderer(scene, stream.index)
    for frames in work.segments:
        with atomic_write(segment_folder(work.folder, frames)) as temporary:
            temporary.mkdir()
            _draw_segment(work, artist, temporary, frames, advance)


def _draw_segment(
    work: Work, artist: CameraRenderer | OnboardRenderer, folder: Path, frames: range, advance: Advance
) -> None:
    """Write the video of a segment; of a static camera, masks and detections too."""
    found = []
    with contextlib.ExitStack() as stack:
        video = stack.enter_context(VideoWriter(folder / _VIDEO, work.scene.scenario.fps, artist.size_wh))
        masks = None
        if work.masks and not work.stream.onboard:
            masks = stack.enter_context(MaskWriter(folder / _MASKS))
        for frame in frames:
            video.write(artist.frame(frame))
            if isinstance(artist, CameraRenderer):
                drones = _silhouettes(artist, frame)
                found.append(detect(work.scene, work.stream.index, frame, drones))
                if masks is not None:
                    _write_masks(masks, work.stream.name, frame, drones, artist)
            advance(1)
    if found:
        write_detections(folder / _BOXES, _concatenated(found))


def join(stream: Stream, parts: Sequence[Path], folder: Path) -> None:
    """Join the segments' videos, and the detections of a static camera.

    Args:
        stream: the stream to write.
        parts: folders of the stream's segments, in order.
        folder: folder of the sequence.

    Raises:
        OutputError: a file cannot be written.
    """
    if not stream.onboard:
        with atomic_write(folder / DETECTIONS / f"{stream.name}_s.csv") as temporary:
            temporary.write_bytes(b"".join((part / _BOXES).read_bytes() for part in parts))
    join_videos(folder / stream.video_file, [part / _VIDEO for part in parts])


def join_masks(parts: Sequence[Path], folder: Path) -> None:
    """Write the archive of all masks.

    Args:
        parts: folders of the segments of all static cameras, in order.
        folder: folder of the sequence.

    Raises:
        OutputError: the archive cannot be written.
    """
    join_archives(folder / MASKS, [part / _MASKS for part in parts])


def _silhouettes(renderer: CameraRenderer, frame: int) -> list[Silhouette]:
    scene, cam = renderer.scene, renderer.cam
    if renderer.lens is None:
        return silhouettes(scene, cam, renderer.backdrop.depth_m, frame)
    depths_m = [view.backdrop.depth_m for view in renderer.views]
    return lens_silhouettes(scene, cam, renderer.lens, depths_m, frame)


def _write_masks(
    writer: MaskWriter, camera: str, frame: int, drones: Sequence[Silhouette], artist: CameraRenderer
) -> None:
    """Write one mask per drone of the scene; the mask of a drone that the camera does not see is black."""
    in_view = {drone.number: drone.mask() for drone in drones}
    black = np.zeros(artist.size_wh[::-1], bool)
    for number in range(1, len(artist.scene.flights) + 1):
        writer.write(camera, number, frame, in_view.get(number, black))


def _concatenated(found: Sequence[Detections]) -> Detections:
    return Detections(
        np.concatenate([detections.frame for detections in found]),
        np.concatenate([detections.xyxy for detections in found]),
        np.concatenate([detections.confidence for detections in found]),
    )

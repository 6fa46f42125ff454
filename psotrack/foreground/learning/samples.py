"""Frames that the network learns from, with what they show; they are made once and stored.

A sample is a reduced frame, the learned background of its camera, the share of each pixel that drones cover, and the
boxes of the drones. Simulated recordings have masks of their drones.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.errors import InputError
from psotrack.foreground.learning.variations import Batch
from psotrack.foreground.silhouettes import ForegroundSettings, coverage, learned_mog2, reduce_frame
from psotrack.recordings import Recording, VideoInfo, digest_video, read_frames
from psotrack.recordings.datasets import MASKS
from psotrack.support import Advance, Report, atomic_write, digest_record, map_in_processes, no_progress

#: Version of the stored samples.
_VERSION = 1
#: Largest number of drones in a frame: the boxes of further ones are not learned.
MOST_DRONES = 16
#: Limits of the random scale of a part of a frame.
_SCALE = (0.7, 1.5)
#: Share of the parts of frames that are cut about a drone; the others are cut anywhere.
_ABOUT_DRONES = 0.7


@dataclass(frozen=True)
class Samples:
    """The samples of one video.

    Attributes:
        image: (samples, height, width, 3), reduced frames, BGR.
        background: (height, width, 3), the learned background.
        covered: (samples, height, width), share of each pixel that drones cover, 0 to 255.
        box_px: (samples, drones, 4), xyxy of the drones' visible parts, pixels of the reduced frame; NaN for no drone.
        key: digest of all that the samples were made of.
    """

    image: UInt8[np.ndarray, "samples height width 3"]
    background: UInt8[np.ndarray, "height width 3"]
    covered: UInt8[np.ndarray, "samples height width"]
    box_px: Float[np.ndarray, "samples drones 4"]
    key: str = ""

    def __len__(self) -> int:
        return len(self.image)

    @classmethod
    def load(cls, folder: Path) -> Samples:
        """Read stored samples; images are read from the disk where they are used."""
        names = ("image", "background", "covered", "box_px")
        arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in names}
        return cls(**arrays, key=folder.name)

    def thinned(self, most: int) -> Samples:
        """Some of the samples, spread over the video."""
        chosen = np.unique(np.linspace(0, len(self) - 1, min(most, len(self))).round().astype(int))
        image, covered, box_px = (each[chosen] for each in (self.image, self.covered, self.box_px))
        return Samples(image, self.background, covered, box_px, self.key)


@dataclass(frozen=True)
class _Task:
    """The samples of one video, and where they are stored."""

    video: VideoInfo
    camera: str
    masks: Path
    frames: list[int]
    settings: ForegroundSettings
    folder: Path


def gather(
    recording: Recording,
    settings: ForegroundSettings,
    *,
    per_camera: int,
    cache: Path,
    jobs: int,
    report: Report = no_progress,
) -> list[Samples]:
    """The samples of a simulated recording, camera by camera.

    Args:
        recording: a recording with videos, and masks of its drones beside them.
        settings: settings of the foreground; `working_reduction` and `num_learning_frames` are used.
        per_camera: largest number of samples of a camera, spread over its video.
        cache: folder for stored results.
        jobs: largest number of processes.
        report: shows the progress in frames.

    Raises:
        InputError: there are no masks, or a video cannot be read.
    """
    masks = recording.folder / MASKS
    if not masks.is_file():
        expected, remedy = f"{MASKS} with the drones' masks", "simulate the sequence with masks"
        raise InputError(recording.folder, expected=expected, found="none", remedy=remedy)
    tasks = []
    for video in recording.videos.values():
        count = min(per_camera, video.num_frames)
        frames = np.unique(np.linspace(0, video.num_frames - 1, count).round().astype(int)).tolist()
        key = {
            "version": _VERSION,
            "video": digest_video(video),
            "masks": [masks.stat().st_size, masks.stat().st_mtime_ns],
            "frames": frames,
            "reduction": settings.working_reduction,
        }
        folder = Path(cache) / "samples" / digest_record(key)
        tasks.append(_Task(video, video.path.stem.removesuffix("_s"), masks, frames, settings, folder))
    missing = [task for task in tasks if not task.folder.exists()]
    with report("samples", sum(task.video.num_frames for task in missing)) as advance:
        map_in_processes(_store, missing, jobs=jobs, advance=advance)
    return [Samples.load(task.folder) for task in tasks]


def _store(task: _Task, advance: Advance) -> None:
    """Make and store the samples of a video."""
    chosen, images = set(task.frames), []
    for number, frame in enumerate(read_frames(task.video)):
        if number in chosen:
            images.append(reduce_frame(frame, task.settings))
        advance(1)
    learned = learned_mog2(((1.0, image) for image in images), task.settings).getBackgroundImage()
    covered, boxes = _drawn(task, images[0].shape[:2])
    with atomic_write(task.folder) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        arrays = {"image": np.stack(images), "background": learned, "covered": covered, "box_px": boxes}
        for name, values in arrays.items():
            np.save(folder / f"{name}.npy", values)


def _drawn(
    task: _Task, shape: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "samples height width"], Float[np.ndarray, "samples drones 4"]]:
    """Coverage and boxes of the drones by their masks."""
    factor, boxes = task.settings.working_reduction, np.full((len(task.frames), MOST_DRONES, 4), np.nan)
    covered = np.zeros((len(task.frames), *shape), np.uint8)
    with zipfile.ZipFile(task.masks) as archive:
        start = f"{task.camera}/dron"
        drones = sorted({name.split("/")[1] for name in archive.namelist() if name.startswith(start)})
        if not drones:
            raise InputError(task.masks, expected=f"masks of camera {task.camera}", found="none")
        for index, frame in enumerate(task.frames):
            whole = np.zeros((1, 1), np.uint8)
            for number, drone in enumerate(drones[:MOST_DRONES]):
                content = archive.read(f"{task.camera}/{drone}/{frame:06d}.png")
                decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
                if decoded is None:
                    raise InputError(task.masks, expected=f"a picture of {drone}", found="a damaged one")
                mask = np.asarray(decoded, np.uint8)
                whole = whole | mask
                x, y, width, height = cv2.boundingRect(mask)
                if width:
                    boxes[index, number] = np.array([x, y, x + width, y + height]) / factor
            covered[index] = coverage(whole, factor)
    return covered, boxes


def batches(
    parts: Sequence[Samples], size: int, count: int, generator: np.random.Generator
) -> Iterator[Batch]:
    """Endless batches of parts of frames, at random places, scales and mirrored or not.

    Args:
        parts: the samples of several videos.
        size: height and width of the parts, pixels.
        count: number of parts in a batch.
        generator: random numbers.
    """
    ends = np.cumsum([len(each) for each in parts])
    while True:
        chosen = [
            _part(parts, int(number), ends, size, generator)
            for number in generator.integers(ends[-1], size=count)
        ]
        image, background, covered, box_px = (np.stack(values) for values in zip(*chosen, strict=True))
        counts, known = np.ones(covered.shape, bool), np.ones(count, bool)
        arrays = image, background, covered, counts, box_px.astype(np.float32), known
        yield Batch(*arrays)


def _part(
    parts: Sequence[Samples],
    number: int,
    ends: Int[np.ndarray, "videos"],
    size: int,
    generator: np.random.Generator,
) -> tuple[np.ndarray, ...]:
    """A part of one frame: image, background, coverage and boxes."""
    which = int(np.searchsorted(ends, number, side="right"))
    samples, index = parts[which], number - int(ends[which]) + len(parts[which])
    height, width = samples.background.shape[:2]
    scale = float(np.exp(generator.uniform(*np.log(_SCALE))))
    side, boxes = size / scale, np.array(samples.box_px[index])
    seen = np.flatnonzero(np.isfinite(boxes[:, 0]))
    if len(seen) and generator.random() < _ABOUT_DRONES:
        box = boxes[generator.choice(seen)]
        middle = (box[:2] + box[2:]) / 2 + generator.uniform(-0.4, 0.4, 2) * side
    else:
        middle = generator.uniform(0, 1, 2) * (width, height)
    # Within the frame, where it is large enough.
    low, high = (
        np.minimum(side, (width, height)) / 2,
        np.maximum((width, height) - np.array(side / 2), (np.array((width, height)) / 2)),
    )
    middle = np.clip(middle, low, high)
    mirror = -1.0 if generator.random() < 0.5 else 1.0
    # A point p of the frame is at scale * (p - middle) + size / 2; edges of pixels are at whole numbers.
    turned = np.array([[mirror * scale, 0.0], [0.0, scale]])
    start = size / 2 - turned @ middle
    pixels = np.column_stack([turned, start + (turned.sum(axis=1) - 1) / 2])

    def cut(image: np.ndarray, border: int) -> np.ndarray:
        return cv2.warpAffine(
            np.ascontiguousarray(image), pixels, (size, size), flags=cv2.INTER_LINEAR, borderMode=border
        )

    corners = boxes.reshape(-1, 2, 2) @ turned.T + start
    cut_boxes = np.clip(np.hstack([corners.min(axis=1), corners.max(axis=1)]), 0, size)
    area, whole = (np.prod(each[:, 2:] - each[:, :2], axis=1) for each in (cut_boxes, boxes * scale))
    # Less than a third of a drone at the border is no drone that can be told.
    cut_boxes[~(area > whole / 3)] = np.nan
    image, background = (
        cut(each, cv2.BORDER_REPLICATE) for each in (samples.image[index], samples.background)
    )
    return image, background, cut(samples.covered[index], cv2.BORDER_CONSTANT), cut_boxes

"""Frames that the network learns from, with what they show; they are made once and stored.

A sample is a reduced frame, the learned background of its camera, the share of each pixel that drones cover, and the
boxes of the drones. Simulated recordings have masks of their drones; of other recordings, the foreground near the
places where tracks have their drones tells the same.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.errors import InputError
from psotrack.foreground.learning.steps import Batch
from psotrack.foreground.learning.tracked import TrackedDrones
from psotrack.foreground.learning.variations import Part, varied
from psotrack.foreground.silhouettes import (
    ForegroundSettings,
    Living,
    coverage,
    learned_mog2,
    learning_step,
    reduce_frame,
    reduced_shape,
)
from psotrack.recordings import Recording, VideoInfo, digest_video, read_frames
from psotrack.recordings.datasets import MASKS
from psotrack.support import (
    Advance,
    Report,
    atomic_write,
    digest_record,
    evenly_spread,
    map_in_processes,
    no_progress,
)

#: Version of the stored samples.
_VERSION = 3
#: Largest number of drones in a frame: the boxes of further ones are not learned.
MOST_DRONES = 16
#: Foreground this share of a box's length beside the box of a track is that of its drone.
_NEAR = 0.3
#: Limits of the random scale of a part of a frame.
_SCALE = (0.6, 1.7)
#: Share of the parts of frames that are cut about a drone; the others are cut anywhere.
_ABOUT_DRONES = 0.7


@dataclass(frozen=True)
class Samples:
    """The samples of one video, or images of one size.

    Attributes:
        image: (samples, height, width, 3), reduced frames, BGR.
        background: (height, width, 3), the learned background.
        covered: (samples, height, width), share of each pixel that drones cover, 0 to 255.
        box_px: (samples, drones, 4), xyxy of the drones' visible parts, pixels of the reduced frame; NaN for no drone.
        key: digest of all that the samples were made of.
        by_boxes: whether only the boxes are known: there is no background, and pixels in boxes may or may not show a
            drone.
    """

    image: UInt8[np.ndarray, "samples height width 3"]
    background: UInt8[np.ndarray, "height width 3"]
    covered: UInt8[np.ndarray, "samples height width"]
    box_px: Float[np.ndarray, "samples drones 4"]
    key: str = ""
    by_boxes: bool = False

    def __len__(self) -> int:
        return len(self.image)

    @classmethod
    def load_all(cls, folder: Path) -> list[Samples]:
        """Read stored samples; images are read from the disk where they are used."""
        found = []
        for part in sorted(folder.iterdir()):
            arrays = {name: np.load(part / f"{name}.npy", mmap_mode="r") for name in _ARRAYS}
            found.append(
                cls(**arrays, key=f"{folder.name}/{part.name}", by_boxes=part.name.endswith(_BY_BOXES))
            )
        return found

    def thinned(self, most: int) -> Samples:
        """Some of the samples, spread over the video."""
        chosen = evenly_spread(len(self), most)
        image, covered, box_px = (each[chosen] for each in (self.image, self.covered, self.box_px))
        return Samples(image, self.background, covered, box_px, self.key, self.by_boxes)


#: Names of the stored arrays, and how folders end whose samples have boxes only.
_ARRAYS = ("image", "background", "covered", "box_px")
_BY_BOXES = "_boxes"


def is_stored(folder: Path) -> bool:
    """Whether samples were stored in a folder."""
    return folder.is_dir()


def store(folder: Path, samples: Sequence[Samples]) -> None:
    """Store samples in a new folder, which appears when it is complete."""
    with atomic_write(folder) as temporary:
        for number, each in enumerate(samples):
            part = temporary / f"{number:03d}{_BY_BOXES if each.by_boxes else ''}"
            part.mkdir(parents=True)
            for name in _ARRAYS:
                np.save(part / f"{name}.npy", getattr(each, name))


@dataclass(frozen=True)
class _Task:
    """The samples of one video, and where they are stored.

    Attributes:
        video: the video.
        frames: numbers of the frames that become samples.
        settings: settings of the foreground.
        masks: the archive with the drones' masks.
        boxes_px: (samples, drones, 4), xyxy of boxes about the drones of tracks, pixels of the frame; None: by masks.
        folder: where the samples are stored.
    """

    video: VideoInfo
    frames: list[int]
    settings: ForegroundSettings
    masks: Path
    boxes_px: Float[np.ndarray, "samples drones 4"] | None
    folder: Path


def gather(
    recording: Recording,
    settings: ForegroundSettings,
    *,
    tracked: TrackedDrones | None = None,
    per_camera: int,
    cache: Path,
    jobs: int,
    report: Report = no_progress,
) -> list[Samples]:
    """The samples of a recording, camera by camera.

    Args:
        recording: a recording with videos, and masks of its drones beside them, or tracks.
        settings: settings of the foreground; `working_reduction` and `num_learning_frames` are used.
        tracked: where the drones are; None: the masks say it.
        per_camera: largest number of samples of a camera, spread over its video.
        cache: folder for stored results.
        jobs: largest number of processes.
        report: shows the progress in frames.

    Raises:
        InputError: there are no masks, or a video cannot be read.
    """
    masks = recording.folder / MASKS
    if tracked is None and not masks.is_file():
        expected = f"{MASKS} with the drones' masks"
        remedy = "simulate the sequence with masks, or learn --from-tracks"
        raise InputError(recording.folder, expected=expected, found="none", remedy=remedy)
    tasks = []
    for name, video in recording.videos.items():
        frames = evenly_spread(video.num_frames, per_camera)
        boxes_px = None if tracked is None else tracked.boxes_px(recording, name, frames)
        shown = [masks.stat().st_size, masks.stat().st_mtime_ns] if boxes_px is None else boxes_px.tolist()
        key = {
            "version": _VERSION,
            "video": digest_video(video),
            "shown": f"{shown}",
            "frames": frames.tolist(),
            "settings": msgspec.to_builtins(settings),
        }
        folder = Path(cache) / "samples" / digest_record(key)
        tasks.append(_Task(video, frames.tolist(), settings, masks, boxes_px, folder))
    missing = [task for task in tasks if not is_stored(task.folder)]
    with report("samples", sum(task.video.num_frames for task in missing)) as advance:
        map_in_processes(_store, missing, jobs=jobs, advance=advance)
    return [samples for task in tasks for samples in Samples.load_all(task.folder)]


def _store(task: _Task, advance: Advance) -> None:
    """Make and store the samples of a video."""
    chosen, images = set(task.frames), []
    for number, frame in enumerate(read_frames(task.video)):
        if number in chosen:
            images.append(reduce_frame(frame, task.settings))
        advance(1)
    learned = learned_mog2(((1.0, image) for image in images), task.settings).getBackgroundImage()
    covered, boxes = _drawn(task, images[0].shape[:2]) if task.boxes_px is None else _found(task)
    known = np.isfinite(covered).all(axis=(1, 2))
    image = np.stack(images)[known]
    store(task.folder, [Samples(image, np.asarray(learned), covered[known].astype(np.uint8), boxes[known])])


def _drawn(
    task: _Task, shape: tuple[int, int]
) -> tuple[Float[np.ndarray, "samples height width"], Float[np.ndarray, "samples drones 4"]]:
    """Coverage and boxes of the drones by their masks."""
    factor, camera = task.settings.working_reduction, task.video.path.stem.removesuffix("_s")
    boxes = np.full((len(task.frames), MOST_DRONES, 4), np.nan)
    covered = np.zeros((len(task.frames), *shape), np.float32)
    with zipfile.ZipFile(task.masks) as archive:
        start = f"{camera}/dron"
        drones = sorted({name.split("/")[1] for name in archive.namelist() if name.startswith(start)})
        if not drones:
            raise InputError(task.masks, expected=f"masks of camera {camera}", found="none")
        for index, frame in enumerate(task.frames):
            whole = np.zeros((1, 1), np.uint8)
            for number, drone in enumerate(drones[:MOST_DRONES]):
                content = archive.read(f"{camera}/{drone}/{frame:06d}.png")
                decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
                if decoded is None:
                    raise InputError(task.masks, expected=f"a picture of {drone}", found="a damaged one")
                mask = np.asarray(decoded, np.uint8)
                whole = whole | mask
                boxes[index, number] = _box_of(mask, 0, 0) / factor
            covered[index] = coverage(whole, factor)
    return covered, boxes


def _found(
    task: _Task,
) -> tuple[Float[np.ndarray, "samples height width"], Float[np.ndarray, "samples drones 4"]]:
    """Coverage and boxes of the drones by the foreground near their tracks.

    The coverage is NaN in a frame in which a drone has no foreground, as where it hovers before a background that is
    learned with it: such a frame would teach that no drone is there.
    """
    assert task.boxes_px is not None
    settings, video = task.settings, task.video
    learning = read_frames(video, learning_step(video.num_frames, settings))
    masks = Living(settings).foreground(learning, read_frames(video))
    chosen = dict(zip(task.frames, task.boxes_px / settings.working_reduction, strict=True))
    covered: list[np.ndarray] = []
    boxes = np.full((len(chosen), MOST_DRONES, 4), np.nan)
    for number, mask in enumerate(masks):
        if number not in chosen:
            continue
        index = len(covered)
        shown = np.full(reduced_shape(video.image_size_wh, settings.working_reduction), np.nan)
        if mask is not None:
            shown = np.zeros(mask.shape)
            for drone, box in enumerate(chosen[number][:MOST_DRONES]):
                if not np.isfinite(box).all():
                    continue
                margin = _NEAR * (box[2:] - box[:2])
                x0, y0 = np.maximum(box[:2] - margin, 0).astype(int)
                x1, y1 = np.ceil(box[2:] + margin).astype(int)
                near = mask[y0:y1, x0:x1]
                boxes[index, drone] = _box_of(near, x0, y0)
                shown[y0:y1, x0:x1] = near if near.any() else np.nan
        covered.append(shown)
    return np.array(covered, np.float32), boxes


def _box_of(mask: UInt8[np.ndarray, "height width"], x0: int, y0: int) -> Float[np.ndarray, "4"]:
    """The box about a part of an image; NaN where nothing is in it."""
    x, y, width, height = cv2.boundingRect(mask)
    return np.array([x + x0, y + y0, x + x0 + width, y + y0 + height]) if width else np.full(4, np.nan)


def batches(
    parts: Sequence[Samples], size: int, count: int, generator: np.random.Generator
) -> Iterator[Batch]:
    """Endless batches of parts of frames, at random places, scales and mirrored or not, with random changes.

    Args:
        parts: the samples of several videos.
        size: height and width of the parts, pixels.
        count: number of parts in a batch.
        generator: random numbers.
    """
    ends = np.cumsum([len(each) for each in parts])

    def draw() -> Part:
        number = int(generator.integers(ends[-1]))
        which = int(np.searchsorted(ends, number, side="right"))
        return _part(parts[which], number - int(ends[which]) + len(parts[which]), size, generator)

    while True:
        chosen = [varied(draw(), draw, generator) for _ in range(count)]
        image, background = (
            np.stack([getattr(each, name).astype(np.uint8) for each in chosen])
            for name in ("image", "background")
        )
        covered = np.stack([np.round(255 * each.covered).astype(np.uint8) for each in chosen])
        by_boxes = np.array([each.by_boxes for each in chosen])
        counts = (covered == 0) | ~by_boxes[:, None, None]
        box_px = np.stack([each.box_px for each in chosen]).astype(np.float32)
        is_known = np.array([each.is_known for each in chosen])
        yield Batch(image, background, covered, counts, box_px, is_known)


def _part(samples: Samples, index: int, size: int, generator: np.random.Generator) -> Part:
    """A part of one frame."""
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
    low = np.minimum(side, (width, height)) / 2
    high = np.maximum((width, height) - np.array(side / 2), (np.array((width, height)) / 2))
    middle = np.clip(middle, low, high)
    mirror = -1.0 if generator.random() < 0.5 else 1.0
    # A point p of the frame is at scale * (p - middle) + size / 2; edges of pixels are at whole numbers.
    turned = np.array([[mirror * scale, 0.0], [0.0, scale]])
    start = size / 2 - turned @ middle
    pixels = np.column_stack([turned, start + (turned.sum(axis=1) - 1) / 2])

    def cut(image: np.ndarray, border: int) -> Float[np.ndarray, "..."]:
        made = cv2.warpAffine(np.ascontiguousarray(image), pixels, (size, size), borderMode=border)
        return np.asarray(made, np.float32)

    corners = boxes.reshape(-1, 2, 2) @ turned.T + start
    cut_boxes = np.clip(np.hstack([corners.min(axis=1), corners.max(axis=1)]), 0, size)
    area, whole = (np.prod(each[:, 2:] - each[:, :2], axis=1) for each in (cut_boxes, boxes * scale))
    # Less than a third of a drone at the border is no drone that can be told.
    cut_boxes[~(area > whole / 3)] = np.nan
    image = cut(samples.image[index], cv2.BORDER_REPLICATE)
    background = cut(samples.background, cv2.BORDER_REPLICATE)
    covered = cut(samples.covered[index], cv2.BORDER_CONSTANT) / 255
    return Part(image, background, covered, cut_boxes, samples.by_boxes, not samples.by_boxes)

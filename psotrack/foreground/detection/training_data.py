"""YOLO data sets for training: images, a text file of labels per image, and `data.yaml` with the parts.

YOLOv5 and its successors use this layout. The labels of images/PART/NAME.jpg are in labels/PART/NAME.txt, one
line per drone: its class, and the middle and size of its box as fractions of the image's width and height.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import yaml
from jaxtyping import Float

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.foreground.detection.settings import LabelSettings
from psotrack.geometry import Camera, has_image, rotation_matrices, to_camera, to_pixels
from psotrack.recordings import Recording, VideoInfo, read_frames_at
from psotrack.support import (
    Advance,
    Report,
    atomic_write,
    check_file_name,
    map_in_processes,
    no_progress,
    refuse_to_overwrite,
)
from psotrack.trajectories import Trajectories, resample

_SIGNS = np.array(list(product((-0.5, 0.5), repeat=3)))


def box_corners(truth: Trajectories, settings: LabelSettings) -> Float[np.ndarray, "frames drones 8 3"]:
    """Corners of the drones' boxes in the world, metres; NaN if the pose is unknown.

    A drone that never has an orientation has a level box.

    Args:
        truth: the reference, with or without orientations.
        settings: settings of the labels.
    """
    corners_m = np.array(settings.offset_m) + _SIGNS * np.array(settings.drone_size_m)
    if truth.orientation_wxyz is not None:
        rotation = rotation_matrices(truth.orientation_wxyz)
        rotation[:, np.isnan(rotation).any(axis=(2, 3)).all(axis=0)] = np.eye(3)
        corners_m = np.matvec(rotation[:, :, None], corners_m)
    return truth.position_m[:, :, None] + corners_m


def label_boxes(
    camera: Camera, corners_m: Float[np.ndarray, "frames drones 8 3"], settings: LabelSettings
) -> Float[np.ndarray, "frames drones 4"]:
    """Boxes of drones in the images of a camera, lens distortion included, cut at the image's border (paper, figure 9).

    The label is the box around the eight projected corners. It is larger than the drone's outline, because drones do
    not reach the corners of their boxes.

    Args:
        camera: the camera.
        corners_m: (frames, drones, 8, 3), corners from `box_corners`, metres.
        settings: settings of the labels.

    Returns:
        (frames, drones, 4), xyxy in pixels in the convention of `boxes`. NaN if the drone is behind the camera or
        beyond the fold of its lens, too little of the drone is in the image, or a nearer drone hides it.
    """
    points_cam = to_camera(camera, corners_m)
    pixels = to_pixels(camera, points_cam)
    # Half a pixel converts from pixel centres at whole numbers to pixel edges at whole numbers.
    whole = np.concatenate([pixels.min(axis=2), pixels.max(axis=2)], axis=-1) + 0.5
    cut = np.clip(whole, 0.0, np.tile(camera.image_size_wh, 2))
    area_px = _area(cut)
    in_image = np.asarray(has_image(camera, points_cam)).all(axis=2)
    in_image &= (area_px > 0) & (area_px >= settings.min_inside * _area(whole))
    # Pairs of a drone and another one, (frames, drones, others).
    box, other = cut[:, :, None], cut[:, None]
    low, high = np.maximum(box, other)[..., :2], np.minimum(box, other)[..., 2:]
    common_px = np.maximum(high - low, 0.0).prod(axis=-1)
    distance_m = np.linalg.norm(points_cam.mean(axis=2), axis=-1)
    nearer = in_image[:, None] & (distance_m[:, None] < distance_m[..., None])
    hidden_px = np.where(nearer, common_px, 0.0).max(axis=2, initial=0.0)
    visible = in_image & (hidden_px <= settings.max_hidden * area_px)
    return np.where(visible[..., None], cut, np.nan)


def _area(xyxy: Float[np.ndarray, "*boxes 4"]) -> Float[np.ndarray, "*boxes"]:
    return (xyxy[..., 2:] - xyxy[..., :2]).prod(axis=-1)


#: Name of the file that describes a data set; every folder with a data set has one.
DATA_SET = "data.yaml"


def write_data_set(
    recordings: Sequence[Recording],
    out: Path | str,
    settings: LabelSettings,
    *,
    validation: Sequence[str] = (),
    force: bool = False,
    jobs: int | None = None,
    report: Report = no_progress,
) -> dict[str, dict[str, int]]:
    """Write images and labels of sequences as a YOLO data set in a new folder.

    Poses at the times of the frames are interpolated, but not over gaps of the reference (see `resample`). Frames in
    which the pose of a drone is unknown are left out, because the drone may be in the image without a label.
    Images without drones have an empty label file, which trainers use as background.

    Args:
        recordings: at least two recordings, each with a reference.
        out: folder of the data set.
        settings: settings of the labels.
        validation: names of the sequences for validation; the others are for training. If there are no names, the last
            sequence is for validation.
        force: replace an existing data set.
        jobs: largest number of processes; None: one per processor.
        report: shows the progress in frames of all cameras.

    Returns:
        Numbers of `images` and `labels` in the parts `train` and `val`.

    Raises:
        SettingsError: two sequences have the same name, a validation name is unknown, or no sequence is left for
            training or validation.
        InputError: a sequence has no reference, no frame with all poses known, or inconsistent videos.
        OutputError: the folder exists and `force` is not set, or it cannot be written.
    """
    out = Path(out)
    parts = parts_of([recording.name for recording in recordings], validation)
    refuse_to_overwrite(out, force)
    if out.exists() and not (out / DATA_SET).is_file():
        expected, remedy = "a new folder, or a data set", f"only a folder with a {DATA_SET} can be replaced"
        raise OutputError(out, expected=expected, found="something else", remedy=remedy)
    with atomic_write(out) as temporary:
        for name in ("images/train", "images/val", "labels/train", "labels/val"):
            (temporary / name).mkdir(parents=True)
        tasks: list[_Task] = []
        for recording in recordings:
            tasks += _tasks(recording, parts[recording.name], settings, temporary)
        with report("label", sum(len(task.frame) for task in tasks)) as advance:
            map_in_processes(_write_camera, tasks, jobs=jobs or os.cpu_count() or 1, advance=advance)
        folders = {"train": "images/train", "val": "images/val"}
        content = {"path": str(out.resolve()), **folders, "nc": 1, "names": ["drone"]}
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        (temporary / DATA_SET).write_text(text, encoding="utf-8")
    counts = {}
    for part in ("train", "val"):
        written = [lines for task in tasks if task.part == part for lines in task.labels]
        counts[part] = {"images": len(written), "labels": "".join(written).count("\n")}
    return counts


@dataclass(frozen=True)
class _Task:
    """The images and labels of one camera.

    Attributes:
        out: folder of the data set.
        part: `train` or `val`.
        stem: beginning of the files' names.
        video: video of the camera.
        frame: numbers of the used frames of the camera.
        labels: content of each frame's label file.
    """

    out: Path
    part: str
    stem: str
    video: VideoInfo
    frame: list[int]
    labels: list[str]


def parts_of(names: Sequence[str], validation: Sequence[str]) -> dict[str, str]:
    """The part of each sequence, `train` or `val`, by the sequence's name."""
    chosen = set(validation or names[-1:])
    if len(set(names)) < len(names) or not chosen < set(names):
        raise SettingsError(
            "sequences",
            expected="different names, some for training and others for validation",
            found=f"{', '.join(names)}, of which {', '.join(sorted(chosen))} for validation",
            remedy="validation on frames of the training flights would prove nothing",
        )
    return {name: "val" if name in chosen else "train" for name in names}


def _tasks(recording: Recording, part: str, settings: LabelSettings, out: Path) -> list[_Task]:
    truth = recording.truth
    if truth is None:
        raise InputError(recording.folder, expected="a reference with the drones' positions", found="none")
    filmed = [each.name for each in recording.placed if each.video is not None]
    recording = recording.usable(filmed, recording.num_frames)
    tasks = []
    for index, (name, video) in enumerate(recording.videos.items()):
        times = recording.by_name[name].times
        assert times is not None, "a video has times"
        frame = np.arange(0, times.num_frames, settings.every)
        corners_m = box_corners(resample(truth, frame, times.time_s[frame]), settings)
        known = np.isfinite(corners_m).all(axis=(1, 2, 3))
        if known.any():
            xyxy = label_boxes(recording.rig.cameras[index], corners_m[known], settings)
            labels = [_lines(boxes, video.image_size_wh) for boxes in xyxy]
            stem = check_file_name(f"{recording.name}_{name}", recording.folder)
            tasks.append(_Task(out, part, stem, video, frame[known].tolist(), labels))
    if not tasks:
        expected = f"a frame in which the poses of all drones are known, with a step of {settings.every}"
        raise InputError(recording.folder, expected=expected, found="none")
    return tasks


def _lines(xyxy: Float[np.ndarray, "drones 4"], image_size_wh: tuple[int, int]) -> str:
    """Lines `class cx cy w h` as fractions of the image's width and height; six decimals are a hundredth of a pixel."""
    corner, far_corner = xyxy[:, :2] / image_size_wh, xyxy[:, 2:] / image_size_wh
    values = np.hstack([(corner + far_corner) / 2, far_corner - corner])
    labelled = values[np.isfinite(values).all(axis=1)].tolist()
    return "".join("0 {:.6f} {:.6f} {:.6f} {:.6f}\n".format(*row) for row in labelled)


def _write_camera(task: _Task, advance: Advance) -> None:
    """Write one camera's images and labels."""
    frames = read_frames_at(task.video, task.frame)
    for (number, image), lines in zip(frames, task.labels, strict=True):
        name = f"{task.part}/{task.stem}_{number:06d}"
        encoded = cv2.imencode(".jpg", image)[1]
        (task.out / "images" / f"{name}.jpg").write_bytes(encoded.tobytes())
        (task.out / "labels" / f"{name}.txt").write_text(lines, encoding="ascii")
        advance(1)

"""YOLO data sets: images, a text file of labels for each, and `data.yaml` that names the parts.

This is what the trainers of YOLOv5 and its successors load: the labels of images/PART/NAME.jpg are in
labels/PART/NAME.txt, a line per drone of its class and its box's middle and size in widths and heights of the image.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from psotrack.detection.labels import LabelSettings, box_corners, label_boxes
from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings import Sequence, VideoInfo, read_frames
from psotrack.support import Advance, Report, atomic_write, map_in_processes, no_progress, refuse_to_overwrite

#: The file that makes a folder a data set.
DATA_SET = "data.yaml"
_CLASS = "drone"
_TRAIN, _VALIDATION = "train", "val"


def write_data_set(
    sequences: Ordered[Sequence],
    out: Path,
    settings: LabelSettings,
    *,
    validation: Ordered[str] = (),
    every: int = 1,
    force: bool = False,
    jobs: int | None = None,
    report: Report = no_progress,
) -> dict[str, dict[str, int]]:
    """Images and labels of sequences as a YOLO data set, in a new folder.

    Frames in which the pose of any drone is not known are left out: it may be in the image without a label. Images
    without drones have an empty file of labels, which trainers take for background.

    Args:
        sequences: two or more, each with a reference.
        out: the folder.
        settings: what is labelled.
        validation: names of the sequences to validate on; the others are trained on. The last one where none is given.
        every: take each so manieth frame.
        force: replace a data set that is there.
        jobs: processes at most; None is one per processor.
        report: told of each frame of each camera.

    Returns:
        Number of `images` and `labels` in the parts `train` and `val`.

    Raises:
        SettingsError: sequences of one name, a name that is none of theirs, or nothing to train on; `every` below 1.
        InputError: a sequence has no reference, none that is known in any frame, or videos that do not fit.
        OutputError: there is a folder already, or it cannot be written.
    """
    parts = _parts([one.name for one in sequences], validation)
    _check_replaceable(out, force)
    if every < 1:
        raise SettingsError("every", expected="1 or more", found=f"{every}")
    with atomic_write(out) as temporary:
        tasks = [
            task for one in sequences for task in _tasks(one, parts[one.name], settings, every, temporary)
        ]
        for kind, part in product(("images", "labels"), (_TRAIN, _VALIDATION)):
            (temporary / kind / part).mkdir(parents=True)
        with report("label", sum(len(task.frame) for task in tasks)) as advance:
            counts = map_in_processes(_write_camera, tasks, jobs=jobs or os.cpu_count() or 1, advance=advance)
        (temporary / DATA_SET).write_text(_yaml(out.resolve()), encoding="utf-8")
    total = {part: Counter(images=0, labels=0) for part in (_TRAIN, _VALIDATION)}
    for task, count in zip(tasks, counts, strict=True):
        total[task.part].update(count)
    return {part: dict(count) for part, count in total.items()}


@dataclass(frozen=True)
class _Task:
    """Images of one camera.

    Attributes:
        out: the data set's folder.
        part: `train` or `val`.
        stem: of the names of files.
        video: of the camera.
        every: step between frames.
        frame: (known,), numbers of the frames to take, multiples of `every`.
        xyxy: (known, drones, 4), NaN where there is no label.
    """

    out: Path
    part: str
    stem: str
    video: VideoInfo
    every: int
    frame: Int[np.ndarray, "known"]
    xyxy: Float[np.ndarray, "known drones 4"]


def _parts(names: Ordered[str], validation: Ordered[str]) -> dict[str, str]:
    """The part that each sequence belongs to."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise SettingsError(
            "sequences",
            expected="a name of its own for each",
            found=f"{twice[0]} more than once",
            remedy="rename a folder",
        )
    if len(names) < 2:
        raise SettingsError(
            "sequences",
            expected="at least two, as whole ones are trained or validated on",
            found=", ".join(names) or "none",
            remedy="frames of one flight on both sides would tell nothing",
        )
    chosen = list(validation) or list(names[-1:])
    unknown = [name for name in chosen if name not in names]
    if unknown:
        raise SettingsError("validation", expected=f"some of {', '.join(names)}", found=", ".join(unknown))
    if len(set(chosen)) >= len(names):
        raise SettingsError(
            "sequences",
            expected="at least one to train on beside those to validate on",
            found=f"{', '.join(names) or 'none'}, all to validate on",
            remedy="frames of one flight on both sides would tell nothing",
        )
    return {name: _VALIDATION if name in chosen else _TRAIN for name in names}


def _check_replaceable(out: Path, force: bool) -> None:
    refuse_to_overwrite(out, force)
    if out.exists() and not (out / DATA_SET).is_file():
        raise OutputError(
            out,
            expected=f"no such folder, or an earlier data set with its {DATA_SET}",
            found="something else",
            remedy="name another folder: nothing but a data set is replaced",
        )


def _tasks(sequence: Sequence, part: str, settings: LabelSettings, every: int, out: Path) -> list[_Task]:
    if sequence.truth is None:
        raise InputError(sequence.folder, expected="a reference that says where drones are", found="none")
    filmed = [name for name in sequence.rig.names if name in sequence.videos]
    truth, sequence = sequence.truth, sequence.usable(filmed, sequence.num_frames)
    wanted = truth.frame[(truth.frame % every == 0) & (truth.frame < sequence.num_frames)]
    corners_m = box_corners(
        truth.at_frames(wanted), np.array(settings.drone_size_m), np.array(settings.offset_m)
    )
    known = np.isfinite(corners_m).all(axis=(1, 2, 3))
    if not known.any():
        raise InputError(
            sequence.folder,
            expected="frames in which the poses of all drones are known",
            found=f"none of the {len(wanted)} that were looked at",
        )
    xyxy = label_boxes(sequence.rig.cameras, corners_m[known], settings)
    return [
        _Task(
            out,
            part,
            f"{sequence.name}_{name}",
            sequence.videos[name],
            every,
            wanted[known],
            xyxy[:, :, index],
        )
        for index, name in enumerate(sequence.rig.names)
    ]


def _write_camera(task: _Task, advance: Advance) -> dict[str, int]:
    """Write one camera's images and labels, and count them."""
    labelled = dict(zip(task.frame.tolist(), task.xyxy, strict=True))
    last = replace(task.video, num_frames=int(task.frame[-1]) + 1)
    num_labels = 0
    for index, image in enumerate(read_frames(last, task.every)):
        boxes = labelled.get(index * task.every)
        if boxes is None:
            continue
        name = f"{task.stem}_{index * task.every:06d}"
        encoded = cv2.imencode(".jpg", image)[1]
        (task.out / "images" / task.part / f"{name}.jpg").write_bytes(encoded.tobytes())
        lines = _lines(boxes[np.isfinite(boxes).all(axis=-1)], task.video.image_size_wh)
        (task.out / "labels" / task.part / f"{name}.txt").write_text("".join(lines), encoding="ascii")
        num_labels += len(lines)
        advance(1)
    return {"images": len(labelled), "labels": num_labels}


def _lines(xyxy: Float[np.ndarray, "labels 4"], image_size_wh: tuple[int, int]) -> list[str]:
    """`class cx cy w h` of each box, in widths and heights of the image; six decimals are a hundredth of a pixel."""
    corner, far_corner = xyxy[:, :2] / image_size_wh, xyxy[:, 2:] / image_size_wh
    values = np.hstack([(corner + far_corner) / 2, far_corner - corner])
    return [" ".join(["0", *(f"{value:.6f}" for value in row)]) + "\n" for row in values]


def _yaml(folder: Path) -> str:
    """What trainers look for; texts are written as in JSON, which YAML reads alike."""
    rows = {
        "path": str(folder),
        "train": f"images/{_TRAIN}",
        "val": f"images/{_VALIDATION}",
        "nc": 1,
        "names": [_CLASS],
    }
    return "".join(f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in rows.items())

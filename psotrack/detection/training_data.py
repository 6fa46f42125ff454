"""YOLO data sets for training: images, a text file of labels per image, and `data.yaml` with the parts.

YOLOv5 and its successors use this layout. The labels of images/PART/NAME.jpg are in labels/PART/NAME.txt, one
line per drone: its class, and the middle and size of its box as fractions of the image's width and height.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from psotrack.detection.labels import LabelSettings, box_corners, label_boxes
from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings import Recording, VideoInfo, read_frames
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

#: Name of the file that describes a data set; every folder with a data set has one.
DATA_SET = "data.yaml"
_CLASS = "drone"
_TRAIN, _VALIDATION = "train", "val"
#: Times that differ by less are one time, seconds: a drone at 20 m/s moves by 2 micrometres.
_ONE_TIME_S = 1e-7


@dataclass(frozen=True)
class FrameSelection:
    """The frames of a data set: which frames are used, and which sequences are for validation.

    Attributes:
        validation: names of the sequences for validation; the other sequences are for training. If there are
            no names, the last sequence is for validation.
        every: step between used frames.

    Raises:
        SettingsError: `every` is below 1.
    """

    validation: Sequence[str] = ()
    every: int = 1

    def __post_init__(self) -> None:
        if self.every < 1:
            raise SettingsError("every", expected="1 or more", found=f"{self.every}")


def write_data_set(
    recordings: Sequence[Recording],
    out: Path | str,
    settings: LabelSettings,
    *,
    selection: FrameSelection = FrameSelection(),
    force: bool = False,
    jobs: int | None = None,
    report: Report = no_progress,
) -> dict[str, dict[str, int]]:
    """Write images and labels of sequences as a YOLO data set in a new folder.

    Frames in which the pose of a drone is unknown are left out, because the drone may be in the image without a label.
    Images without drones have an empty label file, which trainers use as background.

    Args:
        recordings: at least two recordings, each with a reference.
        out: folder of the data set.
        settings: settings of the labels.
        selection: the used frames.
        force: replace an existing data set.
        jobs: largest number of processes; None: one per processor.
        report: shows the progress in frames of all cameras.

    Returns:
        Numbers of `images` and `labels` in the parts `train` and `val`.

    Raises:
        SettingsError: two sequences have the same name, a validation name is unknown, or no sequence is left for
            training.
        InputError: a sequence has no reference, no frame with all poses known, or inconsistent videos.
        OutputError: the folder exists and `force` is not set, or it cannot be written.
    """
    out = Path(out)
    parts = _parts([recording.name for recording in recordings], selection.validation)
    _check_replaceable(out, force)
    with atomic_write(out) as temporary:
        tasks = [
            task
            for recording in recordings
            for task in _tasks(recording, parts[recording.name], settings, selection.every, temporary)
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
    """The images and labels of one camera.

    Attributes:
        out: folder of the data set.
        part: `train` or `val`.
        stem: beginning of the files' names.
        video: video of the camera.
        every: step between used frames.
        frame: (known,), numbers of the used frames of the camera, multiples of `every`.
        xyxy: (known, drones, 4), labels in pixels; NaN without a label.
    """

    out: Path
    part: str
    stem: str
    video: VideoInfo
    every: int
    frame: Int[np.ndarray, "known"]
    xyxy: Float[np.ndarray, "known drones 4"]


def _parts(names: Sequence[str], validation: Sequence[str]) -> dict[str, str]:
    """The part of each sequence, `train` or `val`, by the sequence's name."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise SettingsError(
            "sequences",
            expected="different names",
            found=f"{twice[0]} more than once",
            remedy="rename a folder",
        )
    if len(names) < 2:
        raise SettingsError(
            "sequences",
            expected="at least two sequences, because a sequence is used either for training or for validation",
            found=", ".join(names) or "none",
            remedy="add a sequence: validation on frames of the training flight would prove nothing",
        )
    chosen = list(validation) or list(names[-1:])
    unknown = [name for name in chosen if name not in names]
    if unknown:
        raise SettingsError("validation", expected=f"some of {', '.join(names)}", found=", ".join(unknown))
    if len(set(chosen)) >= len(names):
        raise SettingsError(
            "sequences",
            expected="at least one sequence for training",
            found=f"{', '.join(names) or 'none'}, all for validation",
            remedy="add a sequence, or name fewer for validation",
        )
    return {name: _VALIDATION if name in chosen else _TRAIN for name in names}


def _check_replaceable(out: Path, force: bool) -> None:
    refuse_to_overwrite(out, force)
    if out.exists() and not (out / DATA_SET).is_file():
        raise OutputError(
            out,
            expected=f"a path that does not exist yet, or a data set with a {DATA_SET}",
            found="something else",
            remedy="name another folder: only a data set can be replaced",
        )


def _tasks(recording: Recording, part: str, settings: LabelSettings, every: int, out: Path) -> list[_Task]:
    if recording.truth is None:
        raise InputError(recording.folder, expected="a reference with the drones' positions", found="none")
    filmed = [name for name in recording.rig.names if name in recording.videos]
    recording = recording.usable(filmed, recording.num_frames)
    tasks, num_wanted = [], 0
    for name in recording.rig.names:
        truth = _truth_at_frames(recording, name, every)
        corners_m = box_corners(truth, np.array(settings.drone_size_m), np.array(settings.offset_m))
        known = np.isfinite(corners_m).all(axis=(1, 2, 3))
        num_wanted = max(num_wanted, len(known))
        if known.any():
            xyxy = label_boxes(recording.rig.select((name,)).cameras, corners_m[known], settings)[:, :, 0]
            stem = check_file_name(f"{recording.name}_{name}", recording.folder)
            tasks.append(_Task(out, part, stem, recording.videos[name], every, truth.frame[known], xyxy))
    if not tasks:
        raise InputError(
            recording.folder,
            expected="frames in which the poses of all drones are known",
            found=f"no such frame among the {num_wanted} used frames",
        )
    return tasks


def _truth_at_frames(recording: Recording, name: str, every: int) -> Trajectories:
    """The reference at every `every`-th frame of a camera, at the times of these frames."""
    truth, times = recording.truth, recording.frame_times[name]
    assert truth is not None
    frame = truth.frame[(truth.frame % every == 0) & (truth.frame < times.num_frames)]
    at_instants = truth.at_frames(frame)
    if np.allclose(at_instants.time_s, times.time_s[frame], rtol=0, atol=_ONE_TIME_S):
        return at_instants
    # The rows of the reference are instants of the recording, which are not the frames of this camera.
    frame = np.arange(0, times.num_frames, every)
    return resample(truth, frame, times.time_s[frame])


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
    """Lines `class cx cy w h` as fractions of the image's width and height; six decimals are a hundredth of a pixel."""
    corner, far_corner = xyxy[:, :2] / image_size_wh, xyxy[:, 2:] / image_size_wh
    values = np.hstack([(corner + far_corner) / 2, far_corner - corner])
    return [" ".join(["0", *(f"{value:.6f}" for value in row)]) + "\n" for row in values]


def _yaml(folder: Path) -> str:
    """Text of `data.yaml`; values are written as JSON, which is valid YAML."""
    rows = {
        "path": str(folder),
        "train": f"images/{_TRAIN}",
        "val": f"images/{_VALIDATION}",
        "nc": 1,
        "names": [_CLASS],
    }
    return "".join(f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in rows.items())

"""Samples from a YOLO data set: images with boxes, without backgrounds and masks."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.foreground.detection import DATA_SET
from psotrack.foreground.learning.samples import MOST_DRONES, Samples, is_stored, store
from psotrack.foreground.silhouettes import ForegroundSettings, reduce_frame
from psotrack.recordings import is_image, read_image
from psotrack.support import Report, digest_file, digest_record, no_progress

#: Longest side of the images that the network learns, pixels: larger ones are reduced by a whole number.
_LONGEST_PX = 640


def read_data_set(
    folder: Path, *, cache: Path, report: Report = no_progress
) -> tuple[list[Samples], list[Samples]]:
    """The samples for training and for validation of a YOLO data set, as `psotrack simulate labels` writes it.

    Objects of all classes count as drones.

    Args:
        folder: the folder with data.yaml.
        cache: folder for stored results.
        report: shows the progress in images.

    Raises:
        InputError: a file cannot be read or is not as it should be, or there are no images.
    """
    description = _description(folder)
    root = folder / str(description.get("path") or ".")
    root = root if root.is_dir() else folder  # data sets are moved
    train, validation = (_part(root, description, part, cache, report) for part in ("train", "val"))
    return train, validation


def _description(folder: Path) -> Mapping[str, Any]:
    path = folder / DATA_SET
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(path, expected="the description of a data set in YAML", found="none") from error
    if not isinstance(found, dict):
        raise InputError(path, expected="the description of a data set in YAML", found=type(found).__name__)
    return found


def _part(
    root: Path, description: Mapping[str, Any], part: str, cache: Path, report: Report
) -> list[Samples]:
    named = description.get(part)
    if not isinstance(named, str) or not (root / named).is_dir():
        expected = f"`{part}`, a folder of images in {root}"
        raise InputError(root / DATA_SET, expected=expected, found=f"{named}")
    images = sorted(path for path in (root / named).rglob("*") if is_image(path))
    if not images:
        raise InputError(root / named, expected="images", found="none")
    labels = [_labels_of(image) for image in images]
    made_of = [[image.name, image.stat().st_size, image.stat().st_mtime_ns] for image in images]
    shown = [digest_file(each) if each.exists() else "" for each in labels]
    folder = cache / "samples" / digest_record({"version": 1, "images": made_of, "labels": shown})
    if not is_stored(folder):
        found: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = defaultdict(list)
        with report(f"{part} images", len(images)) as advance:
            for image, label in zip(images, labels, strict=True):
                pixels = np.asarray(read_image(image))
                boxes = _boxes(label, (pixels.shape[1], pixels.shape[0]))
                factor = max(1, math.ceil(max(pixels.shape[:2]) / _LONGEST_PX))
                small = reduce_frame(pixels, ForegroundSettings(reduction=factor, working_reduction=factor))
                height, width = small.shape[0], small.shape[1]
                covered = np.zeros((height, width), np.uint8)
                for x0, y0, x1, y1 in boxes[np.isfinite(boxes[:, 0])] / factor:
                    covered[int(y0) : math.ceil(y1), int(x0) : math.ceil(x1)] = 255
                found[height, width].append((small, covered, boxes / factor))
                advance(1)
        store(folder, [_of_shape(each) for each in found.values()])
    return Samples.load_all(folder)


def _of_shape(found: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Samples:
    image, covered, box_px = (np.stack(values) for values in zip(*found, strict=True))
    return Samples(image, np.zeros_like(image[0]), covered, box_px, by_boxes=True)


def _labels_of(image: Path) -> Path:
    """The label file of an image: images/PART/NAME.jpg has labels/PART/NAME.txt."""
    parts = list(image.parts)
    place = len(parts) - 1 - parts[::-1].index("images") if "images" in parts else None
    if place is not None:
        parts[place] = "labels"
    return Path(*parts).with_suffix(".txt")


def _boxes(label: Path, image_size_wh: tuple[int, int]) -> Float[np.ndarray, "drones 4"]:
    """Boxes, xyxy in pixels; NaN for no drone."""
    boxes = np.full((MOST_DRONES, 4), np.nan)
    if not label.exists():
        return boxes  # an image without drones
    try:
        lines = [line.split() for line in label.read_text(encoding="utf-8").splitlines() if line.strip()]
        values = np.array([[float(each) for each in line[1:5]] for line in lines]).reshape(-1, 4)
    except (UnicodeDecodeError, ValueError) as error:
        expected = "lines of a class and four numbers"
        raise InputError(label, expected=expected, found="something else") from error
    if not ((values >= 0) & (values <= 1)).all():
        raise InputError(label, expected="middles and sizes as shares of the image, 0 to 1", found="others")
    half = values[:MOST_DRONES, 2:] / 2
    corners = np.hstack([values[:MOST_DRONES, :2] - half, values[:MOST_DRONES, :2] + half])
    boxes[: len(corners)] = corners * np.tile(image_size_wh, 2)
    return boxes

"""Markers of images and of videos, and the table that they are written to."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from psotrack.foreground.markers import DetectedMarkers, MarkerDetector
from psotrack.inside_out.frames import Frame, FrameSource, map_ahead, read_ahead
from psotrack.recordings import read_grey
from psotrack.support import Report, atomic_write, no_progress, refuse_to_overwrite

#: Number of threads that detect markers, each in an image of its own.
_WORKERS = min(4, os.cpu_count() or 1)
#: Columns of the table, after the one that says which image or frame.
_COLUMNS = ("id", *(f"{axis}{corner}_px" for corner in range(4) for axis in "xy"), "std_px")


def markers_of_images(
    paths: Sequence[Path], dictionary: str, report: Report = no_progress
) -> Iterator[DetectedMarkers]:
    """Markers of photographs, which may differ in size, one after the other; the search is thorough.

    Raises:
        InputError: a file is no image.
        SettingsError: there is no dictionary of this name.
    """
    return _markers(MarkerDetector(dictionary, thorough=True), read_grey, iter(paths), len(paths), report)


def markers_of_video(
    source: FrameSource, dictionary: str, report: Report = no_progress
) -> Iterator[DetectedMarkers]:
    """Markers of a video's frames, one after the other.

    Raises:
        InputError: the video ends early, or a frame has another size.
        SettingsError: there is no dictionary of this name.
    """
    frames = read_ahead(source.frames())
    return _markers(MarkerDetector(dictionary), Frame.grey, frames, source.num_frames or 0, report)


def _markers(
    detector: MarkerDetector, grey_of: Callable[[Any], Any], items: Iterator[Any], count: int, report: Report
) -> Iterator[DetectedMarkers]:
    with report("markers", count) as advance:
        for markers in map_ahead(lambda item: detector.detect(grey_of(item)), items, _WORKERS):
            advance(1)
            yield markers


def write_marker_table(
    path: Path,
    found: Sequence[DetectedMarkers],
    names: Sequence[str] | None = None,
    *,
    force: bool = False,
) -> None:
    """Write markers as CSV: one row per marker, with image or frame, id, corners and their standard deviation.

    Args:
        path: the file.
        found: markers of each image or frame.
        names: names of the images, for a column `image`; None for a column `frame` with numbers from 0.
        force: replace an existing file.

    Raises:
        OutputError: the file exists, or cannot be written.
    """
    refuse_to_overwrite(path, force)
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("frame" if names is None else "image", *_COLUMNS))
        for where, markers in zip(names or map(str, range(len(found))), found, strict=True):
            for marker, corners, std_px in zip(
                markers.ids.tolist(), markers.corners_px, markers.std_px, strict=True
            ):
                rows.writerow((where, marker, *(f"{value:.3f}" for value in (*corners.ravel(), std_px))))

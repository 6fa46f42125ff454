"""Detections that a network made, stored: one folder for each model, its settings and the videos' content."""

from __future__ import annotations

from pathlib import Path

import msgspec

from psotrack.detection.detector import OnnxDetector, detect
from psotrack.recordings import Sequence, write_detections
from psotrack.support import Report, digest_file, digest_record, no_progress


def stored_detections(
    detector: OnnxDetector, sequence: Sequence, *, cache: Path, report: Report = no_progress
) -> Path:
    """A folder with the detections of each of a sequence's videos; what is not there yet is made.

    Every video's file appears whole or not at all: a call that is interrupted goes on with the next video.

    Args:
        detector: that finds them.
        sequence: fit for use (see `Sequence.usable`).
        cache: below which the folder is.
        report: told of every frame that is looked at.

    Raises:
        InputError: a video cannot be read, or the network cannot be used.
        OutputError: a file cannot be written.
    """
    folder = cache / "detections" / _key(detector, sequence)
    for name, video in sequence.videos.items():
        path = folder / f"{video.path.stem}.csv"
        if not path.exists():
            write_detections(path, detect(detector, name, video, report=report))
    return folder


def _key(detector: OnnxDetector, sequence: Sequence) -> str:
    """40 hexadecimal digits."""
    made_of = {
        "model": digest_file(detector.model),
        "settings": msgspec.to_builtins(detector.settings),
        "videos": {
            name: [video.num_frames, digest_file(video.path)] for name, video in sequence.videos.items()
        },
    }
    return digest_record(made_of)

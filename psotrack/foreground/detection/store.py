"""Stored detections: one folder for each combination of detector, settings and contents of the videos."""

from __future__ import annotations

from pathlib import Path

from psotrack.foreground.detection.detector import Detector, detect_drones
from psotrack.recordings import Recording, digest_video, write_detections
from psotrack.support import Report, check_file_name, digest_record, identify, no_progress


def stored_detections(
    detector: Detector, recording: Recording, *, cache: Path | str, report: Report = no_progress
) -> Path:
    """Detect drones in the videos of a sequence, unless the detections are stored already.

    The file of a video appears when it is complete. A call after an interruption continues with the first video without
    a file.

    Args:
        detector: the detector.
        recording: a consistent recording (see `Recording.usable`).
        cache: folder for stored results.
        report: shows the progress in frames.

    Returns:
        Folder with one file of detections per video.

    Raises:
        InputError: a video cannot be read, or the network cannot be used.
        SettingsError: the detector's key is no plain data, or it yields arrays of wrong shapes.
        OutputError: a file cannot be written.
    """
    videos = {name: [video.num_frames, digest_video(video)] for name, video in recording.videos.items()}
    folder = Path(cache) / "detections" / digest_record({"detector": identify(detector), "videos": videos})
    for name, video in recording.videos.items():
        path = folder / f"{check_file_name(name, recording.folder)}.csv"
        if not path.exists():
            write_detections(path, detect_drones(detector, name, video, report=report))
    return folder

"""Functions that are defined for the public face only: reading a recording, tracking it, and single steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import UInt8

from psotrack.foreground.silhouettes import ForegroundSettings, Living
from psotrack.inside_out.detection import DetectedMarkers, MarkerDetector
from psotrack.pipeline import Parts, TrackedRecording, check_detections, track_recording
from psotrack.recordings import Recording
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings, full_name
from psotrack.support import no_progress, progress_bar, user_cache


def read_recording(
    folder: Path | str, *, cameras: Sequence[str] | str | None = None, num_frames: int | None = None
) -> Recording:
    """Read a recording, checked to be fit for tracking.

    Args:
        folder: a `recording.toml`, a folder that holds one, or a folder of the DPJAIT dataset.
        cameras: names of the cameras to use, or one name; None uses all.
        num_frames: number of first frames to use; None uses all.

    Raises:
        InputError: the folder or one of its files cannot be used; the message says what to do.
        SettingsError: a camera is unknown, or the videos have fewer frames.
    """
    return open_recording(folder).usable(cameras, num_frames, videos=False)


def track(
    recording: Recording | Path | str,
    settings: TrackSettings | Mapping[str, Any] | None = None,
    *,
    cache: Path | str | None = None,
    jobs: int | None = None,
    progress: bool = False,
    **more: Any,
) -> TrackedRecording:
    """Track the drones of a recording.

    Silhouettes are made by several processes: in a script, call this function below `if __name__ == "__main__":`.

    Args:
        recording: recording from `read_recording`, or its `recording.toml` or folder.
        settings: settings, or names and values such as {"swarm.particles": 50}; None takes the defaults.
        cache: folder of stored silhouettes and detections; None takes the user's cache folder.
        jobs: number of processes for the silhouettes; None is one per processor.
        progress: whether to show progress bars.
        **more: single settings by the last part of their names, such as `particles=50`; and parts that the caller
            brings: `search`, `score`, `method`, `background`, `detector` (see `Parts`).

    Raises:
        InputError: a file cannot be used, or no drones are found.
        SettingsError: a setting does not exist, or does not fit the recording.
    """
    # A text is the name of a part, and so a setting.
    parts = {
        name: part
        for name, part in more.items()
        if name in Parts.__annotations__ and not isinstance(part, str)
    }
    single = {full_name(name): value for name, value in more.items() if name not in parts}
    if not isinstance(settings, TrackSettings):
        settings = TrackSettings().changed(settings or {})
    settings = settings.changed(single)
    if not isinstance(recording, Recording):
        recording = read_recording(recording)
        if "detector" not in parts:
            check_detections(recording, settings)
    return track_recording(
        recording,
        settings,
        cache=user_cache() if cache is None else cache,
        jobs=jobs,
        report=progress_bar if progress else no_progress,
        **cast(Parts, parts),
    )


def detect_markers(
    image: UInt8[np.ndarray, "height width"] | UInt8[np.ndarray, "height width 3"],
    dictionary: str = "4x4_1000",
) -> DetectedMarkers:
    """ArUco markers in an image, black on white or inverted, with corners to a tenth of a pixel.

    The search is thorough: it takes seconds in images of tens of megapixels.

    Args:
        image: grey, or BGR as OpenCV reads it.
        dictionary: name of the markers' dictionary.

    Raises:
        SettingsError: there is no dictionary of this name.
    """
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return MarkerDetector(dictionary, thorough=True).detect(np.asarray(grey, np.uint8))


def background_model(settings: ForegroundSettings | None = None) -> Living:
    """The default background model, which goes on learning, with given or default settings."""
    return Living(ForegroundSettings() if settings is None else settings)

"""Videos: what is in them, and their frames in order. (Being written by the video helper.)"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class VideoInfo:
    """A video file that was opened once: frames, exact rate, size."""

    path: Path
    num_frames: int
    fps: float
    image_size_wh: tuple[int, int]

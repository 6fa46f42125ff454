"""Tracks on their way: what each frame says of them, and what they are to those who come and those who are missed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from psotrack.initiation import LostTracks, TrackCandidate

#: How wide a drone looks changes as it turns: what counts is what it was in so many frames.
SPAN_FRAMES = 25


@dataclass(frozen=True)
class Found:
    """What a frame says of a track by itself."""

    position_m: Float[np.ndarray, "3"]
    covariance_m2: Float[np.ndarray, "3 3"]
    disagreement: float
    num_cameras: int
    span_m: Float[np.ndarray, "2"]
    surprising: bool


@dataclass(frozen=True)
class TrackRow:
    """What is known of a track after a frame; found is None where the frame did not show it."""

    frame: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    covariance_m2: Float[np.ndarray, "3 3"]
    num_in_view: int
    found: Found | None

    @property
    def share(self) -> float:
        """Of the cameras that have it in view, those that saw it."""
        num_cameras = 0 if self.found is None else self.found.num_cameras
        return num_cameras / max(num_cameras, self.num_in_view, 1)


@dataclass
class Track:
    """A track on its way: the number of its drone, once it is one; how much the cameras disagree; all of its frames."""

    drone: int | None
    dispersion: float
    rows: list[TrackRow] = field(default_factory=list)
    hits: int = 0
    missed: int = 0

    @property
    def share(self) -> float:
        """Of the cameras that had it in view, those that saw it, in the frames in which it was found."""
        shares = [row.share for row in self.rows if row.found is not None]
        return float(np.mean(shares)) if shares else 0.0

    @property
    def last_found(self) -> TrackRow:
        """The last row in which it was found; the first one if it never was."""
        return next((row for row in reversed(self.rows) if row.found is not None), self.rows[0])

    @property
    def span_m(self) -> Float[np.ndarray, "2"]:
        """Width and height, the median of the last frames; NaN if it was not found in them."""
        spans = [row.found.span_m for row in self.rows[-SPAN_FRAMES:] if row.found is not None]
        return np.median(spans, axis=0) if spans else np.full(2, np.nan)

    @property
    def size_m(self) -> Float[np.ndarray, "3"]:
        """Full lengths along the world's axes, the median of all frames."""
        spans = [row.found.span_m for row in self.rows if row.found is not None]
        width, height = np.median(spans, axis=0) if spans else np.full(2, np.nan)
        return np.array([width, width, height])


def newcomer_of(track: Track) -> TrackCandidate:
    """A track as a newcomer, at the frame in which it began; its velocity is known by now."""
    first, now = track.rows[0], track.rows[-1]
    return TrackCandidate(
        frame=first.frame - now.frame,
        position_m=first.position_m,
        velocity_m_s=now.velocity_m_s,
        size_m=track.size_m,
        num_cameras=first.num_in_view,
        moves=True,
    )


def lost_of(tracks: list[Track], frame: int, fps: float) -> LostTracks:
    """Drones that are missed, as they were when last found."""
    last = [track.last_found for track in tracks]
    return LostTracks(
        drone=np.array([track.drone for track in tracks], int),
        position_m=np.array([row.position_m for row in last]).reshape(-1, 3),
        velocity_m_s=np.array([row.velocity_m_s for row in last]).reshape(-1, 3),
        seconds=np.array([frame - row.frame for row in last], float) / fps,
        size_m=np.array([track.size_m for track in tracks]).reshape(-1, 3),
        doubtful=np.zeros(len(tracks), bool),
        left_m=np.empty((0, 3)),
    )

"""Tracks in progress: their measurements and states, frame by frame, and their role in re-identification."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from psotrack.initiation import LostTracks, TrackCandidate

#: Number of last frames from which a drone's present width is taken: a drone looks wider or narrower as it turns.
SPAN_FRAMES = 25


@dataclass(frozen=True)
class Measurement:
    """The measurement of a track from one frame alone.

    Attributes:
        position_m: (3,), metres.
        covariance_m2: (3, 3), of the position.
        disagreement: squared reprojection errors over the noise, per degree of freedom.
        num_cameras, num_viewpoints: cameras whose detections count, and their viewpoints.
        span_m: (2,), width and height of the drone, metres.
        surprising: whether the position is too far from the expected one to be an error of measurement.
    """

    position_m: Float[np.ndarray, "3"]
    covariance_m2: Float[np.ndarray, "3 3"]
    disagreement: float
    num_cameras: int
    num_viewpoints: int
    span_m: Float[np.ndarray, "2"]
    surprising: bool


@dataclass(frozen=True)
class TrackRow:
    """A track after one frame; `measured` is None where the frame did not show the drone."""

    frame: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    covariance_m2: Float[np.ndarray, "3 3"]
    num_in_view: int
    measured: Measurement | None

    def is_vague(self, max_coasting_std_m: float) -> bool:
        """Whether the drone was not found, and its position has a larger standard deviation along the worst axis."""
        largest_m2 = float(np.linalg.eigvalsh(self.covariance_m2)[-1])
        return self.measured is None and largest_m2 > max_coasting_std_m**2

    @property
    def share(self) -> float:
        """Share of the cameras with the drone in view that saw the drone."""
        num_cameras = 0 if self.measured is None else self.measured.num_cameras
        return num_cameras / max(num_cameras, self.num_in_view, 1)


@dataclass
class Track:
    """A track in progress.

    Attributes:
        drone: number of the drone; None until the track is confirmed to be of a drone.
        dispersion: disagreement of the cameras, averaged over time.
        rows: one for each frame.
        hits: number of frames in which the drone was found.
        agreed_hits: number of frames in which as many viewpoints agreed as are needed to begin a track.
        hits_of_three: number of frames in which at least three viewpoints agreed.
        missed: frames since the drone was last found.
        unseen: frames since any camera last saw the drone.
    """

    drone: int | None
    dispersion: float
    rows: list[TrackRow] = field(default_factory=list)
    hits: int = 0
    agreed_hits: int = 0
    hits_of_three: int = 0
    missed: int = 0
    unseen: int = 0

    @property
    def share(self) -> float:
        """Mean share of the cameras with the drone in view that saw it, over the frames in which it was found."""
        shares = [row.share for row in self.rows if row.measured is not None]
        return float(np.mean(shares)) if shares else 0.0

    @property
    def last_found(self) -> TrackRow:
        """The last row in which the drone was found; the first row if there is none."""
        return next((row for row in reversed(self.rows) if row.measured is not None), self.rows[0])

    @property
    def span_m(self) -> Float[np.ndarray, "2"]:
        """Width and height, median of the last frames, metres; NaN if the drone was not found in them."""
        spans = [row.measured.span_m for row in self.rows[-SPAN_FRAMES:] if row.measured is not None]
        return np.median(spans, axis=0) if spans else np.full(2, np.nan)

    @property
    def size_m(self) -> Float[np.ndarray, "3"]:
        """Full lengths along the world's axes, median of all frames, metres."""
        spans = [row.measured.span_m for row in self.rows if row.measured is not None]
        width, height = np.median(spans, axis=0) if spans else np.full(2, np.nan)
        return np.array([width, width, height])


def as_candidate(track: Track) -> TrackCandidate:
    """A new track as a candidate, at the frame in which it began and with its present velocity."""
    first, last = track.rows[0], track.rows[-1]
    return TrackCandidate(
        frame=first.frame - last.frame,
        position_m=first.position_m,
        velocity_m_s=last.velocity_m_s,
        size_m=track.size_m,
        num_cameras=first.num_in_view,
        moves=True,
    )


def as_lost_tracks(tracks: list[Track], frame: int, fps: float) -> LostTracks:
    """Drones that are not found in a frame, as they were when they were last found."""
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

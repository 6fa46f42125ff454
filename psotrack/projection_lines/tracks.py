"""Tracks in progress: their measurements and states, frame by frame, and their role in re-identification."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from psotrack.initiation import LostTracks, Measurement
from psotrack.tracking import DISPERSION_FRAMES

#: Number of last frames from which a drone's present width is taken: a drone looks wider or narrower as it turns.
SPAN_FRAMES = 25


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
        drone: number of the drone.
        dispersion: disagreement of the cameras, averaged over time.
        rows: one for each frame.
        missed: frames since the drone was last found.
        unseen: frames since any camera last saw the drone.
    """

    drone: int
    dispersion: float
    rows: list[TrackRow] = field(default_factory=list)
    missed: int = 0
    unseen: int = 0

    def append(self, row: TrackRow) -> None:
        """Append the row of a frame."""
        self.rows.append(row)
        if row.measured is not None:
            self.dispersion += (row.measured.disagreement - self.dispersion) / DISPERSION_FRAMES

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


def as_lost_tracks(tracks: list[Track]) -> LostTracks:
    """Drones that are not found, as they were when they were last found."""
    last = [track.last_found for track in tracks]
    return LostTracks(
        drone=np.array([track.drone for track in tracks], int),
        position_m=np.array([row.position_m for row in last]).reshape(-1, 3),
        velocity_m_s=np.array([row.velocity_m_s for row in last]).reshape(-1, 3),
        instant=np.array([row.frame for row in last], int),
        size_m=np.array([track.size_m for track in tracks]).reshape(-1, 3),
        doubtful=np.zeros(len(tracks), bool),
        left_m=np.empty((0, 3)),
    )

"""What the frames so far showed of each drone, in arrays that grow with the number of drones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from psotrack.initiation import LostTracks, Measurement, find_lost_tracks
from psotrack.trajectories import Arrival, DroneSizes, Status, Tracks, padded

#: Number of last frames from which a drone's present width is taken: a drone looks wider or narrower as it turns.
SPAN_FRAMES = 25


@dataclass
class TrackedDrone:
    """A drone and its track.

    Attributes:
        dispersion: disagreement of the cameras, averaged over time.
        missed: frames since the drone was last found.
        unseen: frames since any camera last saw the drone.
    """

    dispersion: float = 1.0
    missed: int = 0
    unseen: int = 0


class History:
    """The drones in all frames so far.

    Args:
        num_frames: number of frames of the recording.
    """

    def __init__(self, num_frames: int) -> None:
        self._arrivals: list[Arrival] = []
        self._span_m = np.empty((num_frames, 0, 2))
        vector = np.empty((num_frames, 0, 3))
        matrix, number = np.empty((num_frames, 0, 3, 3)), np.empty((num_frames, 0))
        whole = number.astype(int)
        sizes = DroneSizes(vector[0], vector[0], vector[0].astype(int), number[0, :, None])
        self._tracks = Tracks(vector, vector, matrix, vector, matrix, number, whole, whole, vector, sizes)

    def grow(self, num_drones: int) -> None:
        """Make room for more drones."""
        self._tracks = self._tracks.with_arrays(lambda name, array: padded(name, array, num_drones))
        self._span_m = padded("span_m", self._span_m, num_drones)

    def begins(self, frame: int, drone: int, *, again: bool) -> None:
        """A drone comes after frame 0, or comes back."""
        if frame > 0:
            self._arrivals.append(Arrival(frame, drone, again))

    def note(
        self,
        at: tuple[int, int],
        position_m: Float[np.ndarray, "3"],
        velocity_m_s: Float[np.ndarray, "3"],
        covariance_m2: Float[np.ndarray, "3 3"],
        measured: Measurement | None,
        num_in_view: int,
    ) -> None:
        """Note a drone.

        Args:
            at: frame and number of the drone.
            position_m, velocity_m_s, covariance_m2: its state after the frame.
            measured: what the frame shows; None where it does not show the drone.
            num_in_view: number of cameras with the drone in view.
        """
        tracks = self._tracks
        tracks.position_m[at], tracks.velocity_m_s[at] = position_m, velocity_m_s
        tracks.covariance_m2[at] = covariance_m2
        tracks.status[at] = int(Status.COASTING)
        if measured is not None:
            tracks.status[at] = int(Status.TRACKED)
            tracks.measured_m[at], tracks.measured_covariance_m2[at] = (
                measured.position_m,
                measured.covariance_m2,
            )
            tracks.num_cameras[at] = measured.num_cameras
            tracks.fitness[at] = measured.num_cameras / max(measured.num_cameras, num_in_view)
            self._span_m[at] = measured.span_m

    def span_m(self, drone: int, frames: slice = slice(None)) -> Float[np.ndarray, "2"]:
        """Width and height of a drone, median of some frames, metres; NaN if the drone was not found in them."""
        spans = self._span_m[frames, drone]
        found = np.isfinite(spans).all(axis=-1)
        return np.median(spans[found], axis=0) if found.any() else np.full(2, np.nan)

    def sizes_m(self, num_drones: int) -> Float[np.ndarray, "drones 3"]:
        """Full lengths along the world's axes, as wide along x as along y, metres."""
        spans = np.array([self.span_m(drone) for drone in range(num_drones)]).reshape(-1, 2)
        return spans[:, [0, 0, 1]]

    def lost(self, num_drones: int, frame: int, fps: float) -> LostTracks:
        """The drones that may be found again after a frame."""
        until = np.s_[: frame + 1, :num_drones]
        return find_lost_tracks(
            self._tracks.position_m[until],
            self._tracks.velocity_m_s[until],
            self._tracks.status[until] == Status.TRACKED,
            self.sizes_m(num_drones),
            np.arange(frame + 1),
            fps,
        )

    def tracks(self, num_drones: int) -> Tracks:
        """The tracks of all drones; the sizes are those of the boxes, and their standard errors are unknown."""
        size_m = self.sizes_m(num_drones).astype(np.float32)
        unknown = np.full_like(size_m, np.nan)
        sizes = DroneSizes(size_m, unknown, np.zeros(size_m.shape, int), np.empty((num_drones, 0)))
        tracks = self._tracks.with_arrays(lambda name, array: padded(name, array, num_drones))
        arrivals = sorted(self._arrivals, key=lambda arrival: arrival.frame)
        return replace(tracks, sizes=sizes, arrivals=tuple(arrivals))

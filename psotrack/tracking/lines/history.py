"""What the frames so far showed of each drone, in arrays that grow with the number of drones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.tracking.births import LostTracks, find_lost_tracks
from psotrack.tracking.matching import Measurement
from psotrack.tracking.swarm import Places
from psotrack.trajectories import ARRAYS, Arrival, Status, Tracks, padded

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
        num_frames, num_cameras: numbers of frames and of cameras of the recording.
    """

    def __init__(self, num_frames: int, num_cameras: int) -> None:
        self._arrivals: list[Arrival] = []
        vector, matrix, number = (np.empty((num_frames, 0, *shape)) for shape in ((3,), (3, 3), ()))
        self._arrays = {
            "position_m": vector,
            "velocity_m_s": vector,
            "covariance_m2": matrix,
            "measured_m": vector,
            "measured_covariance_m2": matrix,
            "fitness": number,
            "num_cameras": number.astype(int),
            "status": number.astype(int),
            "span_m": vector[..., :2],
            "place_px": np.empty((num_frames, 0, num_cameras, 2)),
            "noise_px": np.empty((num_frames, 0, num_cameras)),
        }

    def grow(self, num_drones: int) -> None:
        """Make room for more drones."""
        self._arrays = {name: padded(name, array, num_drones) for name, array in self._arrays.items()}

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
        values = {
            "position_m": position_m,
            "velocity_m_s": velocity_m_s,
            "covariance_m2": covariance_m2,
            "status": int(Status.COASTING),
        }
        if measured is not None:
            values |= {
                "status": int(Status.TRACKED),
                "measured_m": measured.position_m,
                "measured_covariance_m2": measured.covariance_m2,
                "num_cameras": measured.num_cameras,
                "fitness": measured.num_cameras / max(measured.num_cameras, num_in_view),
                "span_m": measured.span_m,
                "place_px": measured.place_px,
                "noise_px": measured.noise_px,
            }
        for name, value in values.items():
            self._arrays[name][at] = value

    def span_m(self, drone: int, frames: slice = slice(None)) -> Float[np.ndarray, "2"]:
        """Width and height of a drone, median of some frames, metres; NaN if the drone was not found in them."""
        spans = self._arrays["span_m"][frames, drone]
        found = np.isfinite(spans).all(axis=-1)
        return np.median(spans[found], axis=0) if found.any() else np.full(2, np.nan)

    def sizes_m(self, num_drones: int) -> Float[np.ndarray, "drones 3"]:
        """Full lengths along the world's axes, as wide along x as along y, metres."""
        spans = np.array([self.span_m(drone) for drone in range(num_drones)]).reshape(-1, 2)
        return spans[:, [0, 0, 1]]

    def lost(self, num_drones: int, frame: int, fps: float, *, counted: bool) -> LostTracks:
        """The drones that may be found again after a frame; `size_m` is NaN where none of their boxes was seen yet."""
        until = np.s_[: frame + 1, :num_drones]
        return find_lost_tracks(
            self._arrays["position_m"][until],
            self._arrays["velocity_m_s"][until],
            self._arrays["status"][until] == Status.TRACKED,
            self.sizes_m(num_drones),
            np.arange(frame + 1),
            fps,
            counted=counted,
        )

    def tracks(self, num_drones: int) -> tuple[Tracks, Places]:
        """The tracks of all drones, and where the cameras show the drones; the sizes are those of the boxes."""
        arrays = {name: array[:, :num_drones] for name, array in self._arrays.items()}
        size_m = self.sizes_m(num_drones).astype(np.float32)
        noise_px = np.repeat(arrays["noise_px"][..., None], 2, axis=-1)
        tracks = Tracks(
            **{name: arrays[name] for name in ARRAYS},
            size_m=size_m,
            size_frames=np.zeros(size_m.shape, int),
            arrivals=tuple(sorted(self._arrivals, key=lambda arrival: arrival.frame)),
        )
        return tracks, Places(arrays["place_px"], noise_px)

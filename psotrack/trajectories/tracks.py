"""Tracks: what every method of tracking yields, before identity swaps are resolved and later frames are used.

The fields are the same for all methods. A number that a method does not compute is NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from psotrack.support import short_repr

Vectors = Float[np.ndarray, "frames drones 3"]
Matrices = Float[np.ndarray, "frames drones 3 3"]
Counts = Int[np.ndarray, "frames drones"]


class Status(IntEnum):
    """Status of a drone in a frame."""

    #: The position comes from a measurement.
    TRACKED = 0
    #: The position is predicted over a gap without measurements.
    COASTING = 1
    #: The position is the last prediction, for display only; the drone counts as missed.
    LOST = 2

    @property
    def label(self) -> str:
        """Word in tables and files."""
        return self.name.lower()


@dataclass(frozen=True)
class Arrival:
    """A drone that came after frame 0, or that came back.

    Attributes:
        frame: number of the video's frame in which its track starts.
        drone: number of the drone.
        again: whether the drone was tracked before, and lost.
    """

    frame: int
    drone: int
    again: bool


@dataclass(frozen=True, repr=False)
class Tracks:
    """Tracks of a whole recording, NumPy arrays with axes (frames, drones, ...).

    A "measured" quantity comes from one frame alone, also where the motion model treats it as an outlier. Every other
    array depends on earlier frames too. Before the first frame of a drone's track, its positions are NaN and its status
    is `lost`.

    Attributes:
        position_m, velocity_m_s: (frames, drones, 3), positions and velocities in the world, metres and m/s.
        covariance_m2: (frames, drones, 3, 3), covariances of the positions, m².
        measured_m: (frames, drones, 3), positions from each frame alone, metres.
        measured_covariance_m2: (frames, drones, 3, 3), covariances of the measured positions, m².
        fitness: (frames, drones), how well the frame fits the position, in [0, 1].
        num_cameras: (frames, drones), cameras that see the drone.
        status: (frames, drones), values of `Status`.
        size_m: (drones, 3), full lengths of the drones along the world's axes, metres.
        size_frames: (drones, 3), number of frames from which each length was learned.
        arrivals: drones that came after frame 0, or that came back.
    """

    position_m: Vectors
    velocity_m_s: Vectors
    covariance_m2: Matrices
    measured_m: Vectors
    measured_covariance_m2: Matrices
    fitness: Float[np.ndarray, "frames drones"]
    num_cameras: Counts
    status: Counts
    size_m: Float[np.ndarray, "drones 3"]
    size_frames: Int[np.ndarray, "drones 3"]
    arrivals: tuple[Arrival, ...] = ()

    __repr__ = short_repr

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.status.shape[0]

    @property
    def num_drones(self) -> int:
        """Number of drones."""
        return self.status.shape[1]

    def with_arrays(self, change: Callable[[str, np.ndarray], np.ndarray]) -> Tracks:
        """These tracks with each array of axes (frames, drones, ...) replaced by `change(name, array)`."""
        changed: dict[str, Any] = {name: change(name, getattr(self, name)) for name in ARRAYS}
        return replace(self, **changed)

    def found_m(self) -> Vectors:
        """(frames, drones, 3), measured positions in float64; NaN in frames in which a drone was not found."""
        found = self.status == Status.TRACKED
        return np.where(found[..., None], np.asarray(self.measured_m, np.float64), np.nan)


#: Names of the arrays of `Tracks` with axes (frames, drones, ...).
ARRAYS = tuple(
    field.name for field in fields(Tracks) if field.name not in ("size_m", "size_frames", "arrivals")
)


def padded(name: str, array: np.ndarray, num_drones: int) -> np.ndarray:
    """An array of `Tracks` with this number of drones: the first ones, then unknown ones, NaN, lost or 0."""
    nothing = np.nan if array.dtype.kind == "f" else 0
    unknown = int(Status.LOST) if name == "status" else nothing
    missing = max(num_drones - array.shape[1], 0)
    pads = [(0, 0), (0, missing), *[(0, 0)] * (array.ndim - 2)]
    return np.pad(array[:, :num_drones], pads, constant_values=unknown)

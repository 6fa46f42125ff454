"""`Trajectories`: where every drone is in every frame. What every method yields and every judge reads."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError

#: Halves of a covariance may differ by this share of its largest entry: some hundred roundings of float32.
SYMMETRY = 1e-5


class Status(IntEnum):
    """What the tracker knows of a drone in a frame."""

    TRACKED = 0
    #: Predicted over a gap.
    COASTING = 1
    #: The last prediction, kept for people to look at; counts as missed.
    LOST = 2

    @property
    def label(self) -> str:
        """The word in tables and files."""
        return self.name.lower()


@dataclass(frozen=True)
class Trajectories:
    """Positions of drones over frames, with what is known beside them.

    A reference has positions, and orientations where they were recorded; a tracker adds velocities, covariances,
    fitness, number of cameras and status. What is not known of one drone in one frame is NaN; what is not known at
    all is None.

    Attributes:
        frame: (frames,), numbers of the video frames, 0-based, increasing.
        time_s: (frames,), seconds since frame 0.
        drones: one name per drone.
        position_m: (frames, drones, 3), world, metres.
        velocity_m_s: (frames, drones, 3), metres per second.
        covariance_m2: (frames, drones, 3, 3), of the positions, world, square metres; symmetric.
        orientation_wxyz: (frames, drones, 4), unit quaternions that turn body into world coordinates.
        fitness: (frames, drones), in [0, 1].
        num_cameras: (frames, drones), cameras that see the drone.
        status: (frames, drones), values of `Status`.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: Float[np.ndarray, "frames"]
    drones: tuple[str, ...]
    position_m: Float[np.ndarray, "frames drones 3"]
    velocity_m_s: Float[np.ndarray, "frames drones 3"] | None = None
    orientation_wxyz: Float[np.ndarray, "frames drones 4"] | None = None
    fitness: Float[np.ndarray, "frames drones"] | None = None
    num_cameras: Int[np.ndarray, "frames drones"] | None = None
    status: Int[np.ndarray, "frames drones"] | None = None
    covariance_m2: Float[np.ndarray, "frames drones 3 3"] | None = None

    def __post_init__(self) -> None:
        frames, drones = len(self.frame), len(self.drones)
        expected = {
            "time_s": (frames,),
            "position_m": (frames, drones, 3),
            "velocity_m_s": (frames, drones, 3),
            "orientation_wxyz": (frames, drones, 4),
            "fitness": (frames, drones),
            "num_cameras": (frames, drones),
            "status": (frames, drones),
            "covariance_m2": (frames, drones, 3, 3),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise InputError(f"trajectories.{name}", expected=f"shape {shape}", found=f"{value.shape}")
        if len(set(self.drones)) < drones:
            raise InputError(
                "trajectories.drones", expected="a name of its own for each", found=f"{self.drones}"
            )
        if np.any(np.diff(self.frame) <= 0):
            raise InputError(
                "trajectories.frame", expected="increasing frame numbers", found="repeats or steps back"
            )
        if self.covariance_m2 is not None:
            _check_symmetric(self.covariance_m2)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.frame)

    @property
    def num_drones(self) -> int:
        """Number of drones."""
        return len(self.drones)

    @property
    def seen(self) -> Bool[np.ndarray, "frames drones"]:
        """(frames, drones), where there is a position that is not `lost`."""
        there = np.isfinite(self.position_m).all(axis=-1)
        return there if self.status is None else there & (self.status != Status.LOST)

    def at_frames(self, frame: Int[np.ndarray, "wanted"]) -> Trajectories:
        """The rows of the wanted frame numbers, which must all be there."""
        index = np.searchsorted(self.frame, frame)
        index_in = np.minimum(index, max(self.num_frames - 1, 0))
        if len(frame) and (self.num_frames == 0 or np.any(self.frame[index_in] != frame)):
            raise InputError(
                "trajectories", expected=f"frames {frame[0]} to {frame[-1]}", found="some missing"
            )

        def rows(value: np.ndarray | None) -> np.ndarray | None:
            return None if value is None else value[index_in]

        return replace(
            self,
            frame=self.frame[index_in],
            time_s=self.time_s[index_in],
            position_m=self.position_m[index_in],
            velocity_m_s=rows(self.velocity_m_s),
            orientation_wxyz=rows(self.orientation_wxyz),
            fitness=rows(self.fitness),
            num_cameras=rows(self.num_cameras),
            status=rows(self.status),
            covariance_m2=rows(self.covariance_m2),
        )


def _check_symmetric(covariance_m2: Float[np.ndarray, "frames drones 3 3"]) -> None:
    """Refuse matrices whose halves differ by more than the rounding of float32 sums; NaN is not known, and passes."""
    asymmetry_m2 = np.abs(covariance_m2 - np.swapaxes(covariance_m2, -1, -2)).max(axis=(-2, -1))
    wrong = asymmetry_m2 > SYMMETRY * np.abs(covariance_m2).max(axis=(-2, -1))
    if wrong.any():
        row, drone = np.argwhere(wrong)[0]
        raise InputError(
            "trajectories.covariance_m2",
            expected="symmetric matrices",
            found=f"{covariance_m2[row, drone].tolist()} in row {row} of drone {drone}",
        )

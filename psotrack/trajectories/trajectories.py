"""`Trajectories`: positions of all drones in all frames, the result of tracking and the input of the evaluation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError
from psotrack.support import html_block, short_repr
from psotrack.trajectories.columns import data_frame, drones_html
from psotrack.trajectories.tracks import Counts, Matrices, Status, Vectors

if TYPE_CHECKING:
    from pandas import DataFrame

#: Quantities with axes (frames, drones, ...), and the shape of one value.
QUANTITIES: dict[str, tuple[int, ...]] = {
    "position_m": (3,),
    "velocity_m_s": (3,),
    "orientation_wxyz": (4,),
    "fitness": (),
    "num_cameras": (),
    "status": (),
    "covariance_m2": (3, 3),
    "relative_covariance_m2": (3, 3),
}
#: Orientations that are the identity in every row, up to rounding of text, say that no orientation is known.
_IDENTITY = 1e-9
#: Largest asymmetry of a covariance relative to its largest element: about a hundred roundings of float32.
SYMMETRY = 1e-5


@dataclass(frozen=True, repr=False)
class Trajectories:
    """Positions of drones over frames, with optional further quantities.

    A reference has positions and, if they were recorded, orientations. A tracker adds velocities, covariances, fitness,
    number of cameras and status. A value that is unknown for one drone in one frame is NaN; a quantity that is unknown
    altogether is None.

    Attributes:
        frame: (frames,), numbers of the video frames, 0-based, increasing.
        time_s: (frames,), times since frame 0, seconds.
        drones: one name per drone.
        position_m: (frames, drones, 3), positions in the world, metres.
        velocity_m_s: (frames, drones, 3), velocities in the world, metres per second.
        orientation_wxyz: (frames, drones, 4), unit quaternions that turn body coordinates into world coordinates.
        fitness: (frames, drones), scores in [0, 1].
        num_cameras: (frames, drones), numbers of cameras that see the drone.
        status: (frames, drones), values of `Status`.
        covariance_m2: (frames, drones, 3, 3), covariances of the positions, square metres; symmetric.
        relative_covariance_m2: (frames, drones, 3, 3), the same without the error that is constant for a drone.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: Float[np.ndarray, "frames"]
    drones: tuple[str, ...]
    position_m: Vectors
    velocity_m_s: Vectors | None = None
    orientation_wxyz: Float[np.ndarray, "frames drones 4"] | None = None
    fitness: Float[np.ndarray, "frames drones"] | None = None
    num_cameras: Counts | None = None
    status: Counts | None = None
    covariance_m2: Matrices | None = None
    relative_covariance_m2: Matrices | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        frames, drones = len(self.frame), len(self.drones)
        shapes = {name: (frames, drones, *shape) for name, shape in QUANTITIES.items()}
        for name, value in {"time_s": self.time_s, **self.quantities()}.items():
            shape = shapes.get(name, (frames,))
            if value.shape != shape:
                raise InputError(f"trajectories.{name}", expected=f"shape {shape}", found=f"{value.shape}")
        if len(set(self.drones)) < drones:
            raise InputError("trajectories.drones", expected="different names", found=f"{self.drones}")
        if np.any(np.diff(self.frame) <= 0):
            raise InputError(
                "trajectories.frame", expected="increasing frame numbers", found="repeats or steps back"
            )
        for name, value in self.quantities().items():
            if name.endswith("covariance_m2"):
                _check_symmetric(name, value)

    def _repr_html_(self) -> str:
        """What a notebook shows: a table with a row for each drone."""
        drones, frames = self.num_drones, self.num_frames
        span = f", {self.time_s[0]:.2f} s to {self.time_s[-1]:.2f} s" if frames else ""
        return html_block(f"Trajectories: {drones} drones, {frames} frames{span}", drones_html(self))

    def to_pandas(self) -> DataFrame:
        """A data frame with the rows and columns of a file of tracks; what is not known is NaN."""
        return data_frame(self)

    def quantities(self) -> dict[str, np.ndarray]:
        """The quantities with axes (frames, drones, ...) that are known, by name."""
        values = {name: getattr(self, name) for name in QUANTITIES}
        return {name: value for name, value in values.items() if value is not None}

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
        """(frames, drones), True where the position is known and the status is not `lost`."""
        finite = np.isfinite(self.position_m).all(axis=-1)
        return finite if self.status is None else finite & (self.status != Status.LOST)

    def without_lost(self) -> Trajectories:
        """These trajectories without the positions and velocities of lost drones, and their covariances."""
        known: dict[str, Any] = {
            name: np.where(self.seen.reshape(*self.seen.shape, *[1] * len(QUANTITIES[name])), value, np.nan)
            for name, value in self.quantities().items()
            if name == "position_m" or name == "velocity_m_s" or name.endswith("covariance_m2")
        }
        return replace(self, **known)

    def at_frames(self, frame: Int[np.ndarray, "wanted"]) -> Trajectories:
        """Trajectories of chosen frames only.

        Args:
            frame: (wanted,), numbers of the frames.

        Raises:
            InputError: a frame does not exist.
        """
        index = np.searchsorted(self.frame, frame)
        index_in = np.minimum(index, max(self.num_frames - 1, 0))
        if len(frame) and (self.num_frames == 0 or np.any(self.frame[index_in] != frame)):
            raise InputError(
                "trajectories", expected=f"frames {frame[0]} to {frame[-1]}", found="some missing"
            )

        return self._with(
            lambda value: value[index_in], frame=self.frame[index_in], time_s=self.time_s[index_in]
        )

    def of_drones(self, index: Sequence[int]) -> Trajectories:
        """Trajectories of chosen drones only, by their indices."""
        drones = tuple(self.drones[each] for each in index)
        return self._with(lambda value: value[:, list(index)], drones=drones)

    def _with(self, change: Callable[[np.ndarray], np.ndarray], **values: Any) -> Trajectories:
        """These trajectories with other values, and all quantities changed."""
        changed: dict[str, Any] = {name: change(value) for name, value in self.quantities().items()}
        return replace(self, **values, **changed)


def timed_path(
    name: str,
    time_s: Float[np.ndarray, "rows"],
    position_m: Float[np.ndarray, "rows 3"],
    orientation_wxyz: Float[np.ndarray, "rows 4"],
    covariance_m2: Float[np.ndarray, "rows 3 3"] | None = None,
) -> Trajectories:
    """The path of one drone, with a frame for each time at which it was seen, seconds, increasing.

    Orientations that are all the identity are left out: formats of poses write it where none is known.
    """
    turned = np.nanmax(np.abs(orientation_wxyz[:, 1:]), initial=0.0) > _IDENTITY
    return Trajectories(
        np.arange(len(time_s)),
        time_s,
        (name,),
        position_m[:, None],
        orientation_wxyz=orientation_wxyz[:, None] if turned else None,
        covariance_m2=None if covariance_m2 is None else covariance_m2[:, None],
    )


def _check_symmetric(name: str, covariance_m2: Matrices) -> None:
    """Raise `InputError` for matrices that are not symmetric up to the rounding of float32 sums; NaN passes."""
    asymmetry_m2 = np.abs(covariance_m2 - np.swapaxes(covariance_m2, -1, -2)).max(axis=(-2, -1))
    wrong = asymmetry_m2 > SYMMETRY * np.abs(covariance_m2).max(axis=(-2, -1))
    if wrong.any():
        row, drone = np.argwhere(wrong)[0]
        raise InputError(
            f"trajectories.{name}",
            expected="symmetric matrices",
            found=f"{covariance_m2[row, drone].tolist()} in row {row} of drone {drone}",
        )

"""What each format of tracks can hold, and what is lost with it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.recordings import Recording
from psotrack.support import short_repr
from psotrack.trajectories import Status, Trajectories


@dataclass(frozen=True)
class TrackFormat:
    """A format of tracks.

    Attributes:
        suffix: ending of the file's name; empty where the format is always a folder.
        is_folder: whether the format may be a folder with several files.
        holds: which of the quantities of `quantities` the format holds.
        entries: names, or patterns of names, of what such a folder contains: a folder with anything else is not
            replaced.
    """

    suffix: str
    is_folder: bool
    holds: frozenset[str]
    entries: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class Footage:
    """The recording from which tracks were made, for formats that hold boxes, cameras or images.

    Attributes:
        recording: the recording.
        size_m: (drones, 3), full lengths of the tracked drones along the world's axes, metres; None if unknown.
        images: whether the images of the cameras are exported too.
    """

    recording: Recording
    size_m: Float[np.ndarray, "drones 3"] | None = field(default=None)
    images: bool = False

    __repr__ = short_repr


_ORIENTATIONS, _TIMES, _COVARIANCES = "orientations", "times", "covariances"
_ALL = frozenset(
    {
        "names of drones",
        _TIMES,
        _ORIENTATIONS,
        _COVARIANCES,
        "covariances without constant errors",
        "velocities",
        "fitness",
        "numbers of cameras",
        "status",
    }
)

#: The formats by name.
FORMATS = {
    "tum": TrackFormat(".tum", True, frozenset({"names of drones", _TIMES, _ORIENTATIONS}), ("*.tum",)),
    "kitti": TrackFormat(
        "", True, frozenset({"names of drones", _TIMES, _ORIENTATIONS}), ("poses", "sequences")
    ),
    "mot": TrackFormat(".txt", True, frozenset(), ("3d", "gt", "trackers")),
    "c3d": TrackFormat(".c3d", False, frozenset({"names of drones"})),
    "mcap": TrackFormat(
        ".mcap",
        True,
        frozenset({"names of drones", _TIMES, _ORIENTATIONS, _COVARIANCES}),
        ("*.mcap", "metadata.yaml"),
    ),
    "csv": TrackFormat(".csv", False, _ALL),
    "parquet": TrackFormat(".parquet", False, _ALL),
    "json": TrackFormat(".json", False, _ALL),
}


def lost_quantities(trajectories: Trajectories, to: str) -> list[str]:
    """What these trajectories have and the format cannot hold, as noun phrases.

    Args:
        trajectories: the trajectories.
        to: name of the format.
    """
    held = FORMATS[to].holds
    known = _known(trajectories)
    lost = [name for name, is_known in known.items() if is_known and name not in held]
    if "status" in held:
        return lost
    hidden = np.isfinite(trajectories.position_m).all(axis=-1) & ~trajectories.seen
    if hidden.any():
        lost.append(f"{int(hidden.sum())} positions of lost drones")
    never = [
        name for name, seen in zip(trajectories.drones, trajectories.seen.T, strict=True) if not seen.any()
    ]
    if never and to != "c3d":
        lost.append(f"drones that are never seen ({', '.join(never)})")
    return lost


def _known(trajectories: Trajectories) -> dict[str, bool]:
    frame, time_s, status = trajectories.frame, trajectories.time_s, trajectories.status
    has_times = len(frame) > 0 and bool(np.abs(time_s - frame * interval_s(trajectories)).max() > 1e-6)
    return {
        "names of drones": trajectories.drones != tuple(str(k + 1) for k in range(trajectories.num_drones)),
        # Frame numbers and a rate say the same as times of equal distance.
        _TIMES: has_times,
        _ORIENTATIONS: _any_known(trajectories.orientation_wxyz),
        _COVARIANCES: _any_known(trajectories.covariance_m2),
        "covariances without constant errors": _any_known(trajectories.relative_covariance_m2),
        "velocities": _any_known(trajectories.velocity_m_s),
        "fitness": _any_known(trajectories.fitness),
        "numbers of cameras": trajectories.num_cameras is not None,
        "status": status is not None and bool((status == Status.COASTING).any()),
    }


def _any_known(values: np.ndarray | None) -> bool:
    return values is not None and bool(np.isfinite(values).any())


def interval_s(trajectories: Trajectories) -> float:
    """Mean time from frame to frame, seconds.

    Raises:
        InputError: there is one frame only, which is not frame 0, at a time that is not above 0.
    """
    frame, time_s = trajectories.frame, trajectories.time_s
    if len(frame) > 1:
        interval = float(np.ptp(time_s) / np.ptp(frame))
    else:
        interval = float(time_s[0] / frame[0]) if len(frame) and frame[0] else 1.0
    if not interval > 0:
        raise InputError("tracks", expected="times that increase from frame to frame", found="equal times")
    return interval


def seen_only(trajectories: Trajectories) -> tuple[Trajectories, list[int]]:
    """The drones that are seen in some frame, and their indices.

    Raises:
        InputError: no drone is ever seen.
    """
    kept = np.flatnonzero(trajectories.seen.any(axis=0)).tolist()
    if not kept:
        raise InputError("tracks", expected="a drone that is seen in some frame", found="none")

    def of_kept(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[:, kept]

    return replace(
        trajectories,
        drones=tuple(trajectories.drones[index] for index in kept),
        position_m=trajectories.position_m[:, kept],
        velocity_m_s=of_kept(trajectories.velocity_m_s),
        orientation_wxyz=of_kept(trajectories.orientation_wxyz),
        fitness=of_kept(trajectories.fitness),
        num_cameras=of_kept(trajectories.num_cameras),
        status=of_kept(trajectories.status),
        covariance_m2=of_kept(trajectories.covariance_m2),
        relative_covariance_m2=of_kept(trajectories.relative_covariance_m2),
    ), kept

"""Two methods' tracks as one: what each measures, weighed by how sure it is.

The swarm finds the middle of a drone's silhouette, the projection lines that of its boxes. These are not the same
place, by a constant for each drone, which is seen and taken out of the lines: so going from the one to the other does
not move a drone. Which of the two is nearer to the body's origin no image shows; the constant goes into the record, so
that who knows one of them has the other.

What is left of the errors has different causes if the boxes are a detector's, and the information adds up (Bar-Shalom
et al. 2001, section 8.3.3: fusion of independent estimates). Boxes of blobs are of the foreground that the swarm sees
too: part of their errors is the same, and says less (Y. Bar-Shalom, L. Campo, The effect of the common process noise on
the two-sensor fused-track covariance, IEEE Transactions on Aerospace and Electronic Systems 22(6), 1986). Where one
does not see a drone the other one does for both.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.motion import GATE_999, filter_measurements
from psotrack.settings import TrackSettings
from psotrack.support import standard_error
from psotrack.tracking import COMMON, Arrival, SizeMeasurements, Tracked, TrackerInfo, motion_params, sizes
from psotrack.trajectories import Status

#: Tracks of one drone are nearer than this, as a median over their frames: offset of the middles, and some noise.
SAME_M = 0.25
#: Frames in common that tell the offset of the middles; of fewer it is taken to be 0.
LEAST_FRAMES = 10
#: Of the normal distribution: its standard deviation over the median of absolute deviations, and the standard error of
#: a median over that of a mean.
MAD_STD, MEDIAN_ERROR = 1.4826, np.sqrt(np.pi / 2)
#: What is farther from the median, in standard deviations, says that a track was elsewhere, not how well that is known.
FAR = 3.0
#: Correlation of errors of two methods that see the same foreground: shadows, noise, and what one drone hides of
#: another are the same, what each makes of them is not.
ALIKE = 0.5


@dataclass(frozen=True)
class Middles:
    """From the middles of drones' silhouettes to those of their boxes: a constant of each drone.

    Attributes:
        off_m: (drones, 3), along the world's axes; NaN where too few frames tell.
        std_m: (drones, 3), its standard error.
    """

    off_m: Float[np.ndarray, "drones 3"]
    std_m: Float[np.ndarray, "drones 3"]


def fuse_tracks(
    swarm: Tracked, lines: Tracked, settings: TrackSettings, *, fps: float, same_foreground: bool = False
) -> tuple[Tracked, Middles]:
    """The tracks of both methods as one, and how far apart the points are that these are of.

    Drones of the swarm keep their numbers; those that only the lines know come after them, unless both look at the same
    foreground: then the swarm has looked there and found none. Positions are of the middles of silhouettes; where only
    the lines see a drone, and no offset is known for it, of the middle of its boxes.

    Args:
        swarm, lines: what each yields of the same frames.
        settings: of the motion model and of coasting.
        fps: frames per second.
        same_foreground: whether the lines are those of blobs of the foreground that the swarm sees.
    """
    of = _same_drones(swarm.info, lines.info)
    alone = np.setdiff1d(np.arange(lines.info.status.shape[1]), of)
    if same_foreground:
        alone = alone[:0]
    # The lines' drones in the order of the swarm's; then those that only the lines know.
    first, second = _columns(swarm.info, len(alone)), _ordered(lines.info, np.concatenate([of, alone]))
    middles = _between(_measured(first), _measured(second))
    measured_m, covariance_m2, was_measured = _weighed(
        first, second, middles, ALIKE if same_foreground else 0.0
    )
    time_s = np.arange(len(measured_m)) / fps
    params = jax.tree.map(
        lambda value: np.asarray(value, np.float64), motion_params(settings, measured_m.shape[1])
    )
    moving = filter_measurements(time_s, measured_m, covariance_m2, was_measured, params)
    unseen = _frames_unseen(was_measured)
    coasting = unseen <= round(settings.max_coasting_s * fps)
    status = np.where(was_measured, Status.TRACKED, np.where(coasting, Status.COASTING, Status.LOST))
    by_swarm = first.status == Status.TRACKED
    info = TrackerInfo(
        position_m=moving.position_m,
        velocity_m_s=moving.velocity_m_s,
        covariance_m2=moving.covariance_m2,
        measured_m=measured_m,
        measured_covariance_m2=covariance_m2,
        fitness=np.where(by_swarm, first.fitness, second.fitness),
        num_cameras=np.maximum(first.num_cameras, second.num_cameras),
        status=status,
    )
    more = jax.tree.map(lambda value: np.asarray(value)[alone], lines.sizes)
    known = swarm.info.status.shape[1]
    renumbered = {int(drone): known + number for number, drone in enumerate(alone)}
    arrivals = [
        Arrival(arrival.frame, renumbered[arrival.drone], arrival.again)
        for arrival in lines.arrivals
        if arrival.drone in renumbered
    ]
    unknown = [(0, 0), (0, len(alone)), (0, 0)]
    tracked = Tracked(
        info=info,
        sizes=jax.tree.map(np.asarray, sizes.with_added_drones(swarm.sizes, more)),
        looks=SizeMeasurements(
            *(
                np.pad(np.asarray(value, np.float64), unknown, constant_values=np.nan)
                for value in (swarm.looks.size_m, swarm.looks.fill)
            )
        ),
        arrivals=(*swarm.arrivals, *arrivals),
        compile_s=swarm.compile_s + lines.compile_s,
    )
    return tracked, middles


def _same_drones(swarm: TrackerInfo, lines: TrackerInfo) -> Int[np.ndarray, "drones"]:
    """(drones of the swarm,), which of the lines' each is; -1 for none."""
    of = np.full(swarm.status.shape[1], -1)
    apart_m = np.linalg.norm(_measured(swarm)[:, :, None] - _measured(lines)[:, None], axis=-1)
    both = np.isfinite(apart_m)
    median_m = np.full(apart_m.shape[1:], np.inf)
    together = both.any(axis=0)
    median_m[together] = np.nanmedian(apart_m[:, together], axis=0)
    # The more frames two tracks share, the more it says that they are one.
    gain = np.where(median_m < SAME_M, both.sum(axis=0), 0)
    for drone, other in zip(*linear_sum_assignment(gain, maximize=True), strict=True):
        if gain[drone, other]:
            of[drone] = other
    return of


def _measured(info: TrackerInfo) -> Float[np.ndarray, "frames drones 3"]:
    """What each frame says by itself; NaN where a drone was not found."""
    found = np.asarray(info.status) == Status.TRACKED
    return np.where(found[..., None], np.asarray(info.measured_m, np.float64), np.nan)


def _columns(info: TrackerInfo, more: int) -> TrackerInfo:
    """The records with more drones at their end, of which nothing is known."""
    count = info.status.shape[1]
    return _ordered(info, np.concatenate([np.arange(count), np.full(more, -1)]))


def _ordered(info: TrackerInfo, drones: Int[np.ndarray, "drones"]) -> TrackerInfo:
    """The records of some drones, in an order; of -1 nothing is known."""

    def chosen(name: str) -> np.ndarray:
        value = np.asarray(getattr(info, name))
        unknown = np.nan if value.dtype.kind == "f" else int(Status.LOST) if name == "status" else 0
        if name == "fitness":
            unknown = 0.0
        nobody = np.full_like(value[:, :1], unknown, shape=(len(value), 1, *value.shape[2:]))
        return np.concatenate([value, nobody], axis=1)[:, drones]

    return TrackerInfo(**{name: chosen(name) for name in vars(info)})


def _between(
    silhouettes_m: Float[np.ndarray, "frames drones 3"], boxes_m: Float[np.ndarray, "frames drones 3"]
) -> Middles:
    """The constants, from frames that show both. Neighbouring frames err alike, and count as fewer."""
    off_m = boxes_m - silhouettes_m
    median_m, std_m = np.full((2, *off_m.shape[1:]), np.nan)
    for drone in np.flatnonzero(np.isfinite(off_m).all(axis=-1).sum(axis=0) >= LEAST_FRAMES):
        median_m[drone] = np.nanmedian(off_m[:, drone], axis=0)
        apart_m = off_m[:, drone] - median_m[drone]
        far_m = FAR * MAD_STD * np.nanmedian(np.abs(apart_m), axis=0)
        std_m[drone] = MEDIAN_ERROR * standard_error(np.clip(apart_m, -far_m, far_m), np.arange(len(off_m)))
    return Middles(median_m, std_m)


def _weighed(
    swarm: TrackerInfo, lines: TrackerInfo, middles: Middles, alike: float
) -> tuple[
    Float[np.ndarray, "frames drones 3"],
    Float[np.ndarray, "frames drones 3 3"],
    Bool[np.ndarray, "frames drones"],
]:
    """What frames say by both methods, with its covariance, and whether they say anything.

    Where the two disagree beyond what their covariances allow, one of them is on another drone or on none: then it is
    the swarm's that counts, as it looks at all of the foreground.
    """
    first_m, second_m = _measured(swarm), _measured(lines)
    first_m2 = np.asarray(swarm.measured_covariance_m2, np.float64)
    # The swarm's has it in already.
    second_m2 = COMMON * np.asarray(lines.measured_covariance_m2, np.float64)
    second_m -= np.nan_to_num(middles.off_m)
    second_m2 += np.nan_to_num(middles.std_m)[..., None] ** 2 * np.eye(3)
    both = np.isfinite(first_m).all(axis=-1) & np.isfinite(second_m).all(axis=-1)
    off_m = np.where(both[..., None], second_m - first_m, 0.0)
    one_m2, other_m2 = (np.where(both[..., None, None], value, np.eye(3)) for value in (first_m2, second_m2))
    solved = np.linalg.solve(one_m2 + other_m2, off_m[..., None])
    agree = both & ((off_m[..., None, :] @ solved)[..., 0, 0] < GATE_999)
    # With the cross-covariance P12 the gain is (P1 - P12) (P1 + P2 - P12 - P21)^-1; it is P1 (P1 + P2)^-1 without.
    cross_m2 = alike * np.linalg.cholesky(one_m2) @ np.linalg.cholesky(other_m2).swapaxes(-1, -2)
    crossed_m2 = cross_m2.swapaxes(-1, -2)
    gain = (one_m2 - cross_m2) @ np.linalg.inv(one_m2 + other_m2 - cross_m2 - crossed_m2)
    together_m = first_m + (gain @ off_m[..., None])[..., 0]
    together_m2 = one_m2 - gain @ (one_m2 - crossed_m2)
    by_swarm = np.isfinite(first_m).all(axis=-1)
    measured_m = np.where(agree[..., None], together_m, np.where(by_swarm[..., None], first_m, second_m))
    covariance_m2 = np.where(
        agree[..., None, None], together_m2, np.where(by_swarm[..., None, None], first_m2, second_m2)
    )
    covariance_m2 = (covariance_m2 + covariance_m2.swapaxes(-1, -2)) / 2
    return measured_m, covariance_m2, np.asarray(np.isfinite(measured_m).all(axis=-1))


def _frames_unseen(was_measured: Bool[np.ndarray, "frames drones"]) -> Int[np.ndarray, "frames drones"]:
    """Frames since each drone was last measured; as many as there are before the first time."""
    frame = np.arange(len(was_measured))[:, None]
    last = np.maximum.accumulate(np.where(was_measured, frame, -len(was_measured)), axis=0)
    return frame - last

"""Groups of drones whose labels are uncertain: how a group starts, grows, and is updated with a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.identity import labellings, likeness
from psotrack.identity.labellings import Bank
from psotrack.identity.likeness import Likeness
from psotrack.identity.records import IdentityParams
from psotrack.identity.tracks import MeasuredTracks
from psotrack.motion import MotionParams

#: Largest number of drones in a group; the nearest drones are grouped first. Four drones have 24 labellings, five 120.
_MAX_GROUP = 4

#: Drones that were near are separate again when their distance exceeds this number times `encounter_m`.
_HYSTERESIS = 1.25

#: Rate of swaps of two tracks while they are near, per second. An encounter lasts some tenths of a second, so without
#: measurements a swap and no swap are about equally likely after it.
_EXCHANGES_PER_S = 5.0

#: Near tracks attract each other. This is the added standard deviation at distance 0, as a share of `encounter_m`; it
#: falls to 0 at `encounter_m`, with the square of the remaining distance.
_PULL = 0.1

#: Ratio of the jerk density during encounters to the usual jerk density, because drones avoid each other. A larger
#: value leaves more encounters undecided; a smaller value swaps labels wrongly.
_AGILITY = 10.0

#: Number of measurements from which a motion state is estimated; older measurements have no more influence.
_WARM_UP = 32


@dataclass(frozen=True, eq=False)
class Group:
    """Drones whose labels are uncertain together.

    Attributes:
        drones, tracks: (drones,), labels of the drones, and their tracks at the beginning: the first labelling.
        first: first frame of the group.
        apart: (drones, drones), whether the two tracks are separate: not near yet, or separate again.
        distance_m: (drones, drones), distance of the tracks when both were last measured; infinite if never.
        near_s: time when two drones of the group were last near, seconds.
        bank: motion states and probabilities of all labellings.
        likeness: sizes that distinguish the drones; None if the sizes are not known well enough.
        log_probability, before: one array per frame, as `labellings.step` returns them.
    """

    drones: Int[np.ndarray, "drones"]
    tracks: Int[np.ndarray, "drones"]
    first: int
    apart: Bool[np.ndarray, "drones drones"]
    distance_m: Float[np.ndarray, "drones drones"]
    near_s: float
    bank: Bank
    likeness: Likeness | None = None
    log_probability: tuple[np.ndarray, ...] = ()
    before: tuple[np.ndarray, ...] = ()


def update_groups(
    groups: list[Group],
    frame: int,
    order: Int[np.ndarray, "frames drones"],
    tracks: MeasuredTracks,
    motion: MotionParams,
    params: IdentityParams,
) -> list[Group]:
    """Join the previous frame's groups by the tracks that are near in this frame, the nearest tracks first."""
    distance_m = tracks.distance_m[frame]
    near = np.argwhere(np.triu(distance_m < params.encounter_m))
    for pair in near[np.argsort(distance_m[tuple(near.T)], kind="stable")].tolist():
        known = [next((group for group in groups if track in group.tracks), None) for track in pair]
        if known[0] is known[1] is not None or sum(_size(group) for group in known) > _MAX_GROUP:
            continue
        groups = [group for group in groups if group not in known]
        one, other = (
            group or _single_group(track, frame, order, tracks, motion, params)
            for group, track in zip(known, pair, strict=True)
        )
        groups.append(_with_likeness(_join(one, other), tracks, order))
    return groups


def _size(group: Group | None) -> int:
    """Number of drones of a group; 1 for a drone without a group."""
    return 1 if group is None else len(group.drones)


def _with_likeness(group: Group, tracks: MeasuredTracks, order: Int[np.ndarray, "frames drones"]) -> Group:
    """The group with the sizes of its drones, learned from the frames before the encounter."""
    past = slice(0, group.first)
    seen_m = np.where(tracks.clear[past, :, None], tracks.size_m[past], np.nan)
    seen_m = seen_m[np.arange(group.first)[:, None], order[past, group.drones]]
    return replace(group, likeness=likeness.learn_likeness(tracks.time_s[past], seen_m))


def _single_group(
    track: int,
    frame: int,
    order: Int[np.ndarray, "frames drones"],
    tracks: MeasuredTracks,
    motion: MotionParams,
    params: IdentityParams,
) -> Group:
    """A group of one drone, with its motion state before a frame."""
    drone = int(np.flatnonzero(order[frame] == track)[0])
    rows = np.flatnonzero(tracks.was_measured[np.arange(frame), order[:frame, drone]])[-_WARM_UP:]
    place = (rows, order[rows, drone])
    measured_m, covariance_m2 = tracks.measured_m[place], tracks.covariance_m2[place]
    if not len(rows):
        # The drone appears in this frame, so only this frame's measurement gives its place.
        rows = np.array([frame])
        measured_m = tracks.measured_m[rows, track]
        covariance_m2 = params.encounter_m**2 * np.eye(3)[None]
    dt_s = np.diff(tracks.time_s[[*rows, max(frame - 1, rows[-1])]])
    missing = _WARM_UP - len(rows)

    def padded(value: np.ndarray) -> np.ndarray:
        return np.concatenate([np.repeat(value[:1], missing, axis=0), value])

    bank = labellings.begin(
        padded(measured_m),
        padded(covariance_m2),
        np.concatenate([np.zeros(missing), dt_s]),
        np.arange(_WARM_UP) > missing,
        _encounter_motion(motion, np.array([drone])),
    )
    return Group(
        np.array([drone]),
        np.array([track]),
        frame,
        np.ones((1, 1), bool),
        np.full((1, 1), np.inf),
        tracks.time_s[frame],
        bank,
    )


def _join(one: Group, other: Group) -> Group:
    """Join two groups; their histories become histories of the labellings of all drones."""
    kept, index = labellings.embedding(len(one.drones), len(other.drones))
    num_frames = max(len(one.before), len(other.before))
    # Labellings that mix the two groups were impossible so far.
    log_probability = np.where(kept, 0.0, labellings.LEAST_LOG) * np.ones((num_frames, 1))
    before = np.where(kept[:, None] & kept, 1.0, np.eye(len(kept))) * np.ones((num_frames, 1, 1))
    for part, pick in ((one, index[:, 0]), (other, index[:, 1])):
        known, came_from = _history(part, num_frames)
        log_probability += np.where(kept, known[:, pick], 0.0)
        before *= np.where(kept[:, None] & kept, came_from[:, pick[:, None], pick], 1.0)
    num = len(one.drones)
    apart = np.ones((num + len(other.drones),) * 2, bool)
    apart[:num, :num], apart[num:, num:] = one.apart, other.apart
    distance_m = np.full(apart.shape, np.inf)
    distance_m[:num, :num], distance_m[num:, num:] = one.distance_m, other.distance_m
    return Group(
        drones=np.concatenate([one.drones, other.drones]),
        tracks=np.concatenate([one.tracks, other.tracks]),
        first=min(one.first, other.first),
        apart=apart,
        distance_m=distance_m,
        near_s=max(one.near_s, other.near_s),
        bank=labellings.join(one.bank, other.bank),
        log_probability=tuple(log_probability),
        before=tuple(before),
    )


def _history(group: Group, num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Log probabilities (frames, labellings) and `before` (frames, labellings, labellings) of the last frames.

    In frames before the group started, the first labelling is certain.
    """
    num = len(group.bank.log_probability)
    missing = num_frames - len(group.before)
    sure = np.where(np.arange(num) == 0, 0.0, labellings.LEAST_LOG)
    return (
        np.array([*[sure] * missing, *group.log_probability]).reshape(num_frames, num),
        np.array([*[np.eye(num)] * missing, *group.before]).reshape(num_frames, num, num),
    )


def update_group(
    group: Group, frame: int, tracks: MeasuredTracks, motion: MotionParams, params: IdentityParams
) -> Group:
    """Update a group with one frame."""
    here = group.tracks
    now_m = tracks.distance_m[frame][np.ix_(here, here)]
    distance_m = np.where(np.isnan(now_m), group.distance_m, now_m)
    near = now_m < params.encounter_m
    dt_s = np.diff(tracks.time_s[[max(frame - 1, 0), frame]])[0]
    pull_m = _pull_m(distance_m.min(axis=1), params)
    bank, before = labellings.step(
        group.bank,
        dt_s,
        labellings.FrameMeasurements(
            tracks.measured_m[frame, here],
            tracks.covariance_m2[frame, here] + pull_m[:, None, None] ** 2 * np.eye(3),
            tracks.was_measured[frame, here],
        ),
        labellings.change_log_probability(near | ~group.apart, _EXCHANGES_PER_S * dt_s),
        likeness.log_likelihood(group.likeness, tracks.size_m[frame, here], tracks.clear[frame, here]),
        _encounter_motion(motion, group.drones),
    )
    return replace(
        group,
        apart=np.where(near, False, group.apart | (now_m > _HYSTERESIS * params.encounter_m)),
        distance_m=distance_m,
        near_s=tracks.time_s[frame] if near.any() else group.near_s,
        bank=bank,
        log_probability=(*group.log_probability, np.asarray(bank.log_probability)),
        before=(*group.before, np.asarray(before)),
    )


def _pull_m(distance_m: Float[np.ndarray, "drones"], params: IdentityParams) -> Float[np.ndarray, "drones"]:
    """(drones,), added standard deviation of each track because of the nearest other track."""
    nearness = np.maximum(1 - distance_m / params.encounter_m, 0.0)
    return _PULL * params.encounter_m * nearness**2


def _encounter_motion(motion: MotionParams, drones: Int[np.ndarray, "drones"]) -> MotionParams:
    """Motion parameters of some drones during an encounter, in float64."""
    params = jax.tree.map(lambda value: np.asarray(value, np.float64), motion)
    return replace(params, jerk_density_m2_s5=_AGILITY * params.jerk_density_m2_s5[drones])

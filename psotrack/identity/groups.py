"""Drones whose labels are in doubt together: how such a group begins, grows, and goes through a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.identity import labellings, likeness
from psotrack.identity.labellings import Bank
from psotrack.identity.likeness import Likeness
from psotrack.identity.records import IdentityParams
from psotrack.identity.tracks import Tracks
from psotrack.motion import MotionParams

#: Drones in one group; of more, the nearest are grouped first. Four have 24 labellings, five 120.
_MAX_GROUP = 4

#: Farther apart than so many times `encounter_m`, and drones that were near are separate again.
_HYSTERESIS = 1.25

#: Exchanges of two tracks per second while they are near. A pass lasts some tenths of a second: after it, an exchange
#: was as likely as not, for all one knows without having looked.
_EXCHANGES_PER_S = 5.0

#: Tracks pull at each other when they are near: standard deviation that is added where they meet, as a share of
#: `encounter_m`; farther apart it falls with the square of what is left of that distance.
_PULL = 0.1

#: Drones that meet give way to one another: their jerk density then, in terms of what it is all in all. Where it is
#: too large more encounters stay undecided, where it is too small labels are exchanged wrongly.
_AGILITY = 10.0

#: Measurements from which a motion state is learned; it forgets the older ones within half as many.
_WARM_UP = 32


@dataclass(frozen=True, eq=False)
class Group:
    """Drones whose labels are in doubt together.

    Attributes:
        drones, tracks: (drones,), their labels, and the tracks that these had at first: the first labelling.
        first: frame.
        apart: (drones, drones), tracks that have not been near yet, or not any more.
        distance_m: (drones, drones), between their tracks when both were measured last; infinite if never.
        near_s: when any two were near last.
        likeness: what tells them apart by size, if anything does.
        log_probability, before: of every frame, as `labellings.step` has them.
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


def grouped(
    groups: list[Group],
    frame: int,
    order: Int[np.ndarray, "frames drones"],
    tracks: Tracks,
    motion: MotionParams,
    params: IdentityParams,
) -> list[Group]:
    """The groups of the frame before, joined by the tracks that are near in this one, the nearest first."""
    distance_m = tracks.distance_m[frame]
    near = np.argwhere(np.triu(distance_m < params.encounter_m))
    for pair in near[np.argsort(distance_m[tuple(near.T)], kind="stable")].tolist():
        known = [next((group for group in groups if track in group.tracks), None) for track in pair]
        if known[0] is known[1] is not None or sum(_size(group) for group in known) > _MAX_GROUP:
            continue
        groups = [group for group in groups if group not in known]
        one, other = (
            group or _alone(track, frame, order, tracks, motion, params)
            for group, track in zip(known, pair, strict=True)
        )
        groups.append(_with_likeness(_joined(one, other), tracks, order))
    return groups


def _size(group: Group | None) -> int:
    """Number of drones; who is in no group is alone."""
    return 1 if group is None else len(group.drones)


def _with_likeness(group: Group, tracks: Tracks, order: Int[np.ndarray, "frames drones"]) -> Group:
    """The group with what could be learned of the sizes of its drones before they met."""
    past = slice(0, group.first)
    seen_m = np.where(tracks.clear[past, :, None], tracks.size_m[past], np.nan)
    seen_m = seen_m[np.arange(group.first)[:, None], order[past, group.drones]]
    return replace(group, likeness=likeness.learn(tracks.time_s[past], seen_m))


def _alone(
    track: int,
    frame: int,
    order: Int[np.ndarray, "frames drones"],
    tracks: Tracks,
    motion: MotionParams,
    params: IdentityParams,
) -> Group:
    """A group of one drone, as it was last known before a frame."""
    drone = int(np.flatnonzero(order[frame] == track)[0])
    rows = np.flatnonzero(tracks.was_measured[np.arange(frame), order[:frame, drone]])[-_WARM_UP:]
    place = (rows, order[rows, drone])
    measured_m, covariance_m2 = tracks.measured_m[place], tracks.covariance_m2[place]
    if not len(rows):
        # It appears here: where, is for the frame itself to say.
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
        _of_drones(motion, np.array([drone])),
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


def _joined(one: Group, other: Group) -> Group:
    """One group of two; what either has been through is told in labellings of both together."""
    kept, index = labellings.embedding(len(one.drones), len(other.drones))
    num_frames = max(len(one.before), len(other.before))
    # What mixes the two was not possible so far, and stayed what it was.
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
        bank=labellings.joined(one.bank, other.bank),
        log_probability=tuple(log_probability),
        before=tuple(before),
    )


def _history(group: Group, num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Log probabilities (frames, labellings) and `before` (frames, labellings, labellings) of the last so many frames.

    In those before the group began, its labels were right.
    """
    num = len(group.bank.log_probability)
    missing = num_frames - len(group.before)
    sure = np.where(np.arange(num) == 0, 0.0, labellings.LEAST_LOG)
    return (
        np.array([*[sure] * missing, *group.log_probability]).reshape(num_frames, num),
        np.array([*[np.eye(num)] * missing, *group.before]).reshape(num_frames, num, num),
    )


def advanced(group: Group, frame: int, tracks: Tracks, motion: MotionParams, params: IdentityParams) -> Group:
    """The group after one frame more."""
    here = group.tracks
    now_m = tracks.distance_m[frame][np.ix_(here, here)]
    distance_m = np.where(np.isnan(now_m), group.distance_m, now_m)
    near = now_m < params.encounter_m
    dt_s = np.diff(tracks.time_s[[max(frame - 1, 0), frame]])[0]
    pull_m = _pull_m(distance_m.min(axis=1), params)
    bank, before = labellings.step(
        group.bank,
        dt_s,
        tracks.measured_m[frame, here],
        tracks.covariance_m2[frame, here] + pull_m[:, None, None] ** 2 * np.eye(3),
        tracks.was_measured[frame, here],
        labellings.change_log_probability(near | ~group.apart, _EXCHANGES_PER_S * dt_s),
        likeness.log_likelihood(group.likeness, tracks.size_m[frame, here], tracks.clear[frame, here]),
        _of_drones(motion, group.drones),
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
    """(drones,), standard deviation that tracks get because of the nearest other."""
    nearness = np.maximum(1 - distance_m / params.encounter_m, 0.0)
    return _PULL * params.encounter_m * nearness**2


def _of_drones(motion: MotionParams, drones: Int[np.ndarray, "drones"]) -> MotionParams:
    """In float64, of these drones only, when they meet."""
    params = jax.tree.map(lambda value: np.asarray(value, np.float64), motion)
    return replace(params, jerk_density_m2_s5=_AGILITY * params.jerk_density_m2_s5[drones])

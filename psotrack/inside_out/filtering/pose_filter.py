"""Where a camera is, on the fly: a causal filter over the poses that single frames tell.

`init`, `predict` and `update` (of `bank`) are the filter of one motion, frame by frame; a pose that does not fit
is gated: it does not count. `step` follows a camera with them. It confirms a start, tells nothing after too long a
gap, and starts anew where poses agree with one another but not with the state: none of them may be wrong for ever.
`follow` is a loop over `step`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from psotrack.inside_out.camera_path import CameraPath, Flag
from psotrack.inside_out.filtering.bank import (
    MeasuredPose,
    PoseEstimate,
    PoseFilterParams,
    PoseState,
    estimate,
    init,
    open_minded,
    predict,
    update,
)
from psotrack.inside_out.filtering.path_rows import PoseRow, path_of, rows_of
from psotrack.trajectories import Status

__all__ = [
    "Following",
    "MeasuredPose",
    "PoseEstimate",
    "PoseFilterParams",
    "PoseState",
    "advance",
    "estimate",
    "expected",
    "follow",
    "init",
    "predict",
    "step",
    "update",
]

#: Poses in a row that tell a turn, which no level that counts foretold, from an outlier.
_TURN_POSES = 2


@dataclass(frozen=True)
class Rival:
    """What poses that did not fit the state agree on.

    Attributes:
        state: by them alone, or by them as a turn that nothing foretold.
        since_s: time of the first of them.
        needed: support with which the rival is believed.
        is_turn: whether it goes on from the state.
    """

    state: PoseState
    since_s: float
    needed: int
    is_turn: bool


@dataclass(frozen=True)
class Following:
    """What `step` hands from frame to frame; `Following()` knows nothing yet.

    Attributes:
        state: what is believed.
        rival: what might be believed instead.
        former: what was believed until a rival was; while it is no longer ago than gaps may be, it may still be right.
        overthrown: the rival that became the state in this very frame.
        recalled: the former state that became the state again in this very frame, as it was foretold.
    """

    state: PoseState | None = None
    rival: Rival | None = None
    former: PoseState | None = None
    overthrown: Rival | None = None
    recalled: PoseState | None = None


def advance(following: Following, time_s: float, params: PoseFilterParams) -> Following:
    """The same at a later time, before its frame is looked at; what is too long ago is forgotten.

    Raises:
        InputError: the time is before that of `following`.
    """
    if following.state is not None and following.state.time_s == time_s:
        return following

    def later(state: PoseState | None) -> PoseState | None:
        if state is None or time_s - state.seen_s > params.longest_gap_s:
            return None
        return predict(state, time_s)

    state, former, rival = later(following.state), later(following.former), following.rival
    rival_state = later(rival.state) if rival else None
    rival = replace(rival, state=rival_state) if rival and rival_state else None
    if state is None and rival is not None:
        return Following(rival.state, former=former, overthrown=rival)
    return Following(state, rival, former)


def expected(following: Following, params: PoseFilterParams) -> PoseEstimate | None:
    """Where the camera should be at the time that `following` was advanced to; None where nothing is confirmed."""
    state = following.state
    return None if state is None or state.support < params.confirm else estimate(state)


def step(following: Following, raw: PoseRow, params: PoseFilterParams) -> tuple[Following, PoseRow]:
    """Follow the camera into the next frame.

    Args:
        following: from the frame before, advanced to this one or not.
        raw: what the frame says by itself; without a pose, its position is NaN.
        params: of the filter.

    Returns:
        What to hand on, and the frame as the filter tells it: `TRACKED` where the frame's pose counted, `COASTING`
        where there was none, or one that was gated, and `LOST`, with NaN, where nothing is confirmed, or too long ago.

    Raises:
        InputError: times do not increase, or a pose's covariance is not positive definite.
    """
    following = advance(following, raw.time_s, params)
    gated = False
    if raw.has_pose:
        overthrown = following.overthrown
        following, gated = _looked(following, measured(raw), params)
        following = replace(following, overthrown=following.overthrown or overthrown)
    told = expected(following, params)
    if told is None or following.state is None:
        return following, lost(raw, gated=gated)
    ambiguity = following.state.ambiguity
    return following, told_row(raw, told, ambiguity, used=raw.has_pose and not gated)


def follow(path: CameraPath, params: PoseFilterParams | None = None) -> CameraPath:
    """What the frames up to each frame say of it.

    Args:
        path: raw poses, each from its frame alone.
        params: of the filter.

    Raises:
        InputError: a pose's covariance is not positive definite.
    """
    params = params or PoseFilterParams()
    following, rows = Following(), []
    for raw in rows_of(path):
        following, row = step(following, raw, params)
        rows.append(row)
    return path_of(rows)


def measured(row: PoseRow) -> MeasuredPose:
    """The pose of a frame that has one; where nothing is said of its ambiguity, it has none."""
    ambiguity = float(np.nan_to_num(row.ambiguity))
    return MeasuredPose(row.time_s, row.position_m, row.orientation_wxyz, row.covariance, ambiguity)


def told_row(raw: PoseRow, told: PoseEstimate, ambiguity: float, *, used: bool) -> PoseRow:
    """A frame with the pose that is told of it, by its own pose or without."""
    flags = Flag(raw.flags)
    if raw.has_pose and not used:
        flags |= Flag.GATED
    if ambiguity < raw.ambiguity:
        flags &= ~Flag.AMBIGUOUS
    return replace(
        raw,
        position_m=told.position_m,
        orientation_wxyz=told.orientation_wxyz,
        covariance=told.covariance,
        ambiguity=ambiguity,
        status=int(Status.TRACKED if used else Status.COASTING),
        flags=int(flags),
        velocity_m_s=told.velocity_m_s,
    )


def lost(raw: PoseRow, *, gated: bool = False) -> PoseRow:
    """A frame of which no pose is told."""
    return replace(
        raw,
        position_m=np.full(3, np.nan),
        orientation_wxyz=np.full(4, np.nan),
        covariance=np.full((6, 6), np.nan),
        ambiguity=np.nan,
        status=int(Status.LOST),
        flags=int(Flag(raw.flags) | Flag.GATED if gated else raw.flags),
        velocity_m_s=np.full(3, np.nan),
    )


def _looked(
    following: Following, measurement: MeasuredPose, params: PoseFilterParams
) -> tuple[Following, bool]:
    """After a measured pose, and whether it was gated."""
    if following.state is None:
        return Following(init(measurement)), False
    state, gated = update(following.state, measurement, params)
    former, rival = following.former, following.rival
    if former is not None:
        again, strange = update(former, measurement, params)
        if not strange and (gated or again.log_density > state.log_density):
            return Following(again, recalled=former), False
    strange = True
    if rival is not None:
        rival_state, strange = update(rival.state, measurement, params)
        rival = replace(rival, state=rival_state)
    if rival is None or strange:
        rival = _begun(state, measurement, params) if gated else None
        return Following(state, rival, former), gated
    if not gated and rival.state.log_density <= state.log_density:
        return Following(state, former=former), False
    # The pose is the rival's, even where the state, vague by now, would have it too.
    if rival.state.support >= rival.needed:
        return Following(rival.state, former=former or following.state, overthrown=rival), False
    return Following(following.state, rival, former), True


def _begun(state: PoseState, measurement: MeasuredPose, params: PoseFilterParams) -> Rival:
    """A rival of a state, by a pose that does not fit it: the camera turned as nothing foretold, or is elsewhere."""
    if state.support >= params.confirm:
        turned, strange = update(open_minded(state), measurement, params)
        if not strange:
            return Rival(turned, measurement.time_s, state.support + _TURN_POSES, is_turn=True)
    needed = min(params.restart_after, state.support + 1)
    return Rival(init(measurement), measurement.time_s, needed, is_turn=False)

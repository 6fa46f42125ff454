"""Where a camera is, on the fly: a causal filter over the poses that single frames tell.

`init`, `predict` and `update` (of `bank`) are the filter of one motion, frame by frame; a pose that does not fit
is gated: it does not count. `step` follows a camera with them. It confirms a start, tells nothing after too long a
gap, and starts anew where poses agree with one another but not with the state: none of them may be wrong for ever.
What was known before a gap is kept, and grows vague: poses after it that this does not foretell need others, as they do
against a state, or markers that agree beyond chance where it does not contradict them. `follow` is a loop over `step`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.filtering.bank import PoseState, estimate, init, open_minded, predict, update
from psotrack.inside_out.filtering.path_rows import PoseRow, lost, measured, path_of, rows_of, told_row
from psotrack.inside_out.filtering.records import MeasuredPose, PoseEstimate, PoseFilterParams

__all__ = [
    "FilterRun",
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
#: A camera that is somewhere within so much, along an axis, may be anywhere in a room.
_ANYWHERE_M = 10.0


@dataclass(frozen=True)
class Rival:
    """What poses that did not fit the state agree on.

    Attributes:
        state: by them alone, or by them as a turn that nothing foretold.
        since_s: time of the first of them.
        needed: support with which the rival is believed.
        goes_on: whether the camera may have come there from where the state has it.
    """

    state: PoseState
    since_s: float
    needed: int
    goes_on: bool


@dataclass(frozen=True)
class FilterRun:
    """What `step` hands from frame to frame; `FilterRun()` knows nothing yet.

    Attributes:
        state: what is believed.
        rival: what might be believed instead.
        former: what was believed until a rival was; while it is no longer ago than gaps may be, it may still be right.
        overthrown: the rival that became the state in this very frame.
        recalled: the former state that became the state again in this very frame, as it was foretold.
        before: what was known before too long a gap, until the camera is found again.
        strange: whether the state contradicts that.
    """

    state: PoseState | None = None
    rival: Rival | None = None
    former: PoseState | None = None
    overthrown: Rival | None = None
    recalled: PoseState | None = None
    before: PoseState | None = None
    strange: bool = False


def advance(following: FilterRun, time_s: float, params: PoseFilterParams) -> FilterRun:
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
    before = following.state if state is None and confirmed(following, params) else following.before
    if before is not None:
        before = predict(before, time_s)
        before = None if _anywhere(before) else before
    if state is None and rival is not None:
        return FilterRun(rival.state, former=former, overthrown=rival, before=before)
    strange = before is not None and following.strange
    return FilterRun(state, rival, former, before=before, strange=strange)


def expected(following: FilterRun, params: PoseFilterParams) -> PoseEstimate | None:
    """Where the camera should be at the time that `following` was advanced to; None where nothing is confirmed."""
    return estimate(following.state) if following.state and confirmed(following, params) else None


def confirmed(following: FilterRun, params: PoseFilterParams) -> bool:
    """Whether the state is to be told: enough poses agree, or the markers of one of them do, beyond chance.

    Behind a gap, poses that what was known before does not foretell need as many as they would against a state, and
    where they contradict it, markers that agree do not change that.
    """
    state = following.state
    if state is None:
        return False
    needed = params.confirm if following.before is None else max(params.confirm, params.restart_after)
    return state.support >= needed or (state.doubt < params.false_alarm and not following.strange)


def step(following: FilterRun, raw: PoseRow, params: PoseFilterParams) -> tuple[FilterRun, PoseRow]:
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
    following, rows = FilterRun(), []
    for raw in rows_of(path):
        following, row = step(following, raw, params)
        rows.append(row)
    return path_of(rows)


def _looked(
    following: FilterRun, measurement: MeasuredPose, params: PoseFilterParams
) -> tuple[FilterRun, bool]:
    """After a measured pose, and whether it was gated."""
    before, strange = following.before, False
    if before is not None:
        again, strange = update(before, measurement, params)
        if not strange and _foretold(again, params):
            return FilterRun(again, recalled=before), False
    if following.state is None:
        anew = init(measurement)
        began = None if before is None else Rival(anew, measurement.time_s, 1, goes_on=not strange)
        found, gated = FilterRun(anew, overthrown=began), False
    else:
        found, gated = _compared(following, following.state, measurement, params)
        strange = strange if found.overthrown else following.strange
    found = replace(found, before=before, strange=strange)
    return replace(found, before=None, strange=False) if confirmed(found, params) else found, gated


def _compared(
    following: FilterRun, state: PoseState, measurement: MeasuredPose, params: PoseFilterParams
) -> tuple[FilterRun, bool]:
    """After a measured pose, where there is a state, and whether it was gated."""
    foretold = state
    state, gated = update(foretold, measurement, params)
    former, rival = following.former, following.rival
    if former is not None:
        again, strange = update(former, measurement, params)
        if not strange and (gated or again.log_density > state.log_density):
            return FilterRun(again, recalled=former), False
    strange = True
    if rival is not None:
        rival_state, strange = update(rival.state, measurement, params)
        rival = replace(rival, state=rival_state)
    if rival is None or strange:
        rival = _begun(state, measurement, params) if gated else None
        return FilterRun(state, rival, former), gated
    if not gated and rival.state.log_density <= state.log_density:
        return FilterRun(state, former=former), False
    # The pose is the rival's, even where the state, vague by now, would have it too.
    if rival.state.support >= rival.needed:
        return FilterRun(rival.state, former=former or foretold, overthrown=rival), False
    return FilterRun(foretold, rival, former), True


def _begun(state: PoseState, measurement: MeasuredPose, params: PoseFilterParams) -> Rival:
    """A rival of a state, by a pose that does not fit it: the camera turned as nothing foretold, or is elsewhere."""
    sure = state.doubt < params.false_alarm
    if sure or state.support >= params.confirm:
        turned, strange = update(open_minded(state), measurement, params)
        if not strange and _foretold(turned, params):
            return Rival(turned, measurement.time_s, state.support + _TURN_POSES, goes_on=True)
    needed = params.restart_after if sure else min(params.restart_after, state.support + 1)
    return Rival(init(measurement), measurement.time_s, needed, goes_on=False)


def _anywhere(state: PoseState) -> bool:
    return bool(np.linalg.eigvalsh(estimate(state).covariance[:3, :3])[-1] > _ANYWHERE_M**2)


def _foretold(state: PoseState, params: PoseFilterParams) -> bool:
    """Whether the last pose that fitted is likelier by the motion than somewhere within a metre and a radian, and by so
    much that it is an outlier less often than good poses are gated."""
    return bool(state.log_density > -np.log(params.false_alarm))

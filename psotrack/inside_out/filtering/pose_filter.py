"""Causal filter over the poses of single frames: each frame's estimate uses this frame and earlier ones only.

`init`, `predict` and `update` (of `multiple_models`) filter one continuous motion; a pose that does not fit it is gated
and not used. `step` follows a camera with these functions. It returns poses once the first ones are confirmed, and none
after too long a gap. It replaces its state where successive poses agree with one another but not with the state, so
that no wrong state lasts. The state before a gap is kept and predicted, with growing uncertainty. After the gap, poses
that this state does not predict need the same number of confirmations as poses that contradict a state, or markers that
agree beyond chance in a pose that does not contradict the kept state. `filter_path` is a loop over `step`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.filtering.multiple_models import (
    PoseState,
    estimate,
    init,
    predict,
    update,
    with_equal_weights,
)
from psotrack.inside_out.filtering.path_rows import (
    PoseRow,
    estimated_row,
    join_rows,
    lost_row,
    measured_pose,
    split_path,
)
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
    "filter_path",
    "init",
    "predict",
    "step",
    "update",
]

#: Number of successive poses that distinguish a turn, which no level of agility predicted, from an outlier.
_TURN_POSES = 2
#: Standard deviation along an axis, metres, from which on the camera may be anywhere in a room.
_ANYWHERE_M = 10.0


@dataclass(frozen=True)
class Alternative:
    """Alternative state, from poses that did not fit the state.

    Attributes:
        state: state by these poses alone, or by these poses as a turn that no level of agility predicted.
        since_s: time of the first of these poses, seconds.
        needed: number of poses after which the alternative replaces the state.
        continuous: whether the camera can have moved there from the state, so that the motion has no jump.
    """

    state: PoseState
    since_s: float
    needed: int
    continuous: bool


@dataclass(frozen=True)
class FilterRun:
    """What `step` passes on from frame to frame; `FilterRun()` is the beginning, without any pose.

    Attributes:
        state: current state.
        alternative: state that is suggested by poses that contradict the current state.
        previous: state that an alternative replaced; it may still prove right while its last pose is no longer ago
            than the longest gap.
        adopted: alternative that became the state in this frame.
        restored: previous state, as predicted, that became the state again in this frame.
        before_gap: state before too long a gap, kept until the camera is found again.
        contradicts: whether the state contradicts the state before the gap.
    """

    state: PoseState | None = None
    alternative: Alternative | None = None
    previous: PoseState | None = None
    adopted: Alternative | None = None
    restored: PoseState | None = None
    before_gap: PoseState | None = None
    contradicts: bool = False


def advance(run: FilterRun, time_s: float, params: PoseFilterParams) -> FilterRun:
    """Predict a run to the time of the next frame; states without a pose for too long are dropped.

    Raises:
        InputError: the time is before the time of the run.
    """
    if run.state is not None and run.state.time_s == time_s:
        return run

    def later(state: PoseState | None) -> PoseState | None:
        if state is None or time_s - state.seen_s > params.longest_gap_s:
            return None
        return predict(state, time_s)

    state, previous, alternative = later(run.state), later(run.previous), run.alternative
    alternative_state = later(alternative.state) if alternative else None
    alternative = replace(alternative, state=alternative_state) if alternative and alternative_state else None
    before_gap = run.state if state is None and confirmed(run, params) else run.before_gap
    if before_gap is not None:
        before_gap = predict(before_gap, time_s)
        before_gap = None if _is_anywhere(before_gap) else before_gap
    if state is None and alternative is not None:
        return FilterRun(alternative.state, previous=previous, adopted=alternative, before_gap=before_gap)
    contradicts = before_gap is not None and run.contradicts
    return FilterRun(state, alternative, previous, before_gap=before_gap, contradicts=contradicts)


def expected(run: FilterRun, params: PoseFilterParams) -> PoseEstimate | None:
    """Estimate at the time to which the run was advanced; None where no state is confirmed."""
    return estimate(run.state) if run.state and confirmed(run, params) else None


def confirmed(run: FilterRun, params: PoseFilterParams) -> bool:
    """Whether the state may be returned: enough poses agree, or the markers of one pose agree beyond chance.

    After a gap, poses that the state before the gap does not predict need as many confirmations as poses that
    contradict a state. Where poses contradict the state before the gap, markers that agree do not replace
    confirmations.
    """
    state = run.state
    if state is None:
        return False
    needed = params.confirm if run.before_gap is None else max(params.confirm, params.restart_after)
    return state.support >= needed or (state.p_wrong < params.false_alarm and not run.contradicts)


def step(run: FilterRun, raw: PoseRow, params: PoseFilterParams) -> tuple[FilterRun, PoseRow]:
    """Follow the camera into the next frame.

    Args:
        run: result of the frame before, advanced to this frame or not.
        raw: this frame's own pose; its position is NaN where there is none.
        params: parameters of the filter.

    Returns:
        The run for the next frame, and this frame with its estimate: `TRACKED` where the frame's own pose was used,
        `COASTING` where there was none or it was gated, and `LOST`, with NaN, where no state is confirmed.

    Raises:
        InputError: times do not increase, or a pose's covariance is not positive definite.
    """
    run = advance(run, raw.time_s, params)
    gated = False
    if raw.has_pose:
        adopted = run.adopted
        run, gated = _use_pose(run, measured_pose(raw), params)
        run = replace(run, adopted=run.adopted or adopted)
    estimated = expected(run, params)
    if estimated is None or run.state is None:
        return run, lost_row(raw, gated=gated)
    return run, estimated_row(raw, estimated, run.state.ambiguity, used=raw.has_pose and not gated)


def filter_path(path: CameraPath, params: PoseFilterParams | None = None) -> CameraPath:
    """Filter a path: the estimate in each frame uses this frame and earlier ones.

    Args:
        path: raw poses, each from its frame alone.
        params: parameters of the filter.

    Raises:
        InputError: a pose's covariance is not positive definite.
    """
    params = params or PoseFilterParams()
    run, rows = FilterRun(), []
    for raw in split_path(path):
        run, row = step(run, raw, params)
        rows.append(row)
    return join_rows(rows)


def _use_pose(run: FilterRun, measurement: MeasuredPose, params: PoseFilterParams) -> tuple[FilterRun, bool]:
    """The run after a measured pose, and whether the pose was gated."""
    before_gap, contradicts = run.before_gap, False
    if before_gap is not None:
        updated, contradicts = update(before_gap, measurement, params)
        if not contradicts and _is_predicted(updated, params):
            return FilterRun(updated, restored=before_gap), False
    if run.state is None:
        first = init(measurement)
        adopted = (
            None
            if before_gap is None
            else Alternative(first, measurement.time_s, 1, continuous=not contradicts)
        )
        found, gated = FilterRun(first, adopted=adopted), False
    else:
        found, gated = _use_pose_with_state(run, run.state, measurement, params)
        contradicts = contradicts if found.adopted else run.contradicts
    found = replace(found, before_gap=before_gap, contradicts=contradicts)
    return replace(found, before_gap=None, contradicts=False) if confirmed(found, params) else found, gated


def _use_pose_with_state(
    run: FilterRun, state: PoseState, measurement: MeasuredPose, params: PoseFilterParams
) -> tuple[FilterRun, bool]:
    """The run after a measured pose, where there is a state, and whether the pose was gated."""
    predicted = state
    state, gated = update(predicted, measurement, params)
    previous, alternative = run.previous, run.alternative
    if previous is not None:
        updated, outside = update(previous, measurement, params)
        if not outside and (gated or updated.log_density > state.log_density):
            return FilterRun(updated, restored=previous), False
    outside = True
    if alternative is not None:
        alternative_state, outside = update(alternative.state, measurement, params)
        alternative = replace(alternative, state=alternative_state)
    if alternative is None or outside:
        alternative = _first_alternative(state, measurement, params) if gated else None
        return FilterRun(state, alternative, previous), gated
    if not gated and alternative.state.log_density <= state.log_density:
        return FilterRun(state, previous=previous), False
    # The pose belongs to the alternative, even where the state has grown uncertain enough to accept it.
    if alternative.state.support >= alternative.needed:
        return FilterRun(alternative.state, previous=previous or predicted, adopted=alternative), False
    return FilterRun(predicted, alternative, previous), True


def _first_alternative(state: PoseState, measurement: MeasuredPose, params: PoseFilterParams) -> Alternative:
    """An alternative by one pose that does not fit the state: an unpredicted turn, or a camera that is elsewhere."""
    sure = state.p_wrong < params.false_alarm
    if sure or state.support >= params.confirm:
        turned, outside = update(with_equal_weights(state), measurement, params)
        if not outside and _is_predicted(turned, params):
            return Alternative(turned, measurement.time_s, state.support + _TURN_POSES, continuous=True)
    needed = params.restart_after if sure else min(params.restart_after, state.support + 1)
    return Alternative(init(measurement), measurement.time_s, needed, continuous=False)


def _is_anywhere(state: PoseState) -> bool:
    """Whether the position is so uncertain that the camera may be anywhere in a room."""
    return bool(np.linalg.eigvalsh(estimate(state).covariance[:3, :3])[-1] > _ANYWHERE_M**2)


def _is_predicted(state: PoseState, params: PoseFilterParams) -> bool:
    """Whether the last pose is predicted by the motion rather than an outlier.

    The density of the pose must exceed the density of an outlier within a metre and a radian by the factor
    1 / `false_alarm`: then outliers are accepted less often than good poses are rejected.
    """
    return bool(state.log_density > -np.log(params.false_alarm))

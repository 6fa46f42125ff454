"""How wildly a camera moves, chosen for a recording by the likelihood of its poses."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from psotrack.inside_out.filtering.motion import Agility
from psotrack.inside_out.filtering.pose_filter import FilterRun, PoseFilterParams, step
from psotrack.inside_out.pose import CameraPose

#: Factor between neighbouring values, and largest number of steps from the defaults: accelerations from 0.05 to
#: 500 m/s², changes of the turn rate from 0.03 to 300 rad/s.
_FACTOR, _MOST_STEPS = 10.0**0.25, 8
#: Lengths of the search's steps: with the last alone, a flight like none of the defaults would take many.
_STRIDES = (2, 1)
#: Number of successive poses that are looked at together, and largest number of such windows.
_WINDOW, _MOST_WINDOWS = 60, 4
#: What a step from the defaults costs of the log likelihood, so that a few poses do not decide.
_STEP_COST = 0.25


def choose_agility(
    time_s: Sequence[float], poses: Sequence[CameraPose | None], params: PoseFilterParams
) -> Agility:
    """The most likely agility of a camera, by a search along both numbers in turn.

    Args:
        time_s: times of the frames, seconds.
        poses: the frames' own poses; None for a frame without one.
        params: parameters of the filter.
    """
    seen = [one for one in zip(time_s, poses, strict=True) if one[1] is not None]
    last = max(len(seen) - _WINDOW, 0)
    starts = np.unique(np.linspace(0, last, min(_MOST_WINDOWS, 1 + -(-last // _WINDOW))).astype(int))
    windows = [seen[start : start + _WINDOW] for start in starts]

    @cache
    def likelihood(along: int, about: int) -> float:
        steps = abs(along), abs(about)
        if max(steps) > _MOST_STEPS:
            return -np.inf
        total = -_STEP_COST * sum(steps)
        for window in windows:
            run = FilterRun()
            for at_s, pose in window:
                run = step(run, float(at_s), pose, params, _agility(along, about))
            total += run.log_likelihood
        return total

    best = (0, 0)
    for stride in _STRIDES:
        while (better := max(_around(best, stride), key=lambda steps: likelihood(*steps))) != best:
            best = better
    return _agility(*best)


def _around(steps: tuple[int, int], stride: int) -> list[tuple[int, int]]:
    """These steps, and those that differ from them by a stride in one number."""
    along, about = steps
    beside = [(along + sign * stride, about) for sign in (-1, 1)]
    return [steps, *beside, *((along, about + sign * stride) for sign in (-1, 1))]


def _agility(along: int, about: int) -> Agility:
    default = Agility()
    return Agility(
        float(default.acceleration_std_m_s2 * _FACTOR**along),
        float(default.rate_change_std_rad_s * _FACTOR**about),
    )

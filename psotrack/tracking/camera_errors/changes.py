"""A camera that changes in mid-flight: it is knocked and shows everything elsewhere, or loses frames.

Each camera's places are compared with where the other cameras put the body. A change is a step between two frames that
windows of some frames on both sides show as large as long ones do, and all frames before and after that the same
cameras show: of the places, or of the time by which they follow the body's motion. How large a step has to be, the
recording itself shows: errors that change with the attitude and the place of a body make differences between
neighbouring windows everywhere. Where another camera begins or ends to see the body, or nobody sees the body for a
time, the errors of a rig make steps of their own, which are no changes of a camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.tracking.camera_errors.variance_components import FittedPlaces, of_rows
from psotrack.tracking.camera_errors.views import CameraViews

#: Numbers of frames of the windows that are compared.
_WINDOWS = (10, 20, 40, 80)
#: A step has this many times the length that a difference between neighbouring windows usually has.
_CLEAR = 6.0
#: Least part of a step that the shortest window shows; part that windows of twice the length, and all frames before and
#: after show: errors of a lens grow as a body comes to the border.
_SUDDEN, _STAYS = 0.5, (0.75, 1 / 0.75)
#: Largest length of both windows, in frames of the recording for each frame that the camera shows.
_DENSE = 2.0
#: Smallest knock, pixels of an image of 1920 columns: a calibration's own error. Smallest step of a clock, frames: a
#: lost frame is a whole one.
_LEAST_PX, _LEAST_FRAMES = 1.5, 0.6
#: Part of what is told of a change along all axes that is too little along one of them.
_LEAST_TOLD = 0.01
#: Median of a squared length of one or two components of variance 1 (χ² distribution), by their number.
_CHI2_MEDIAN = {1: 0.4549, 2: 1.386}


@dataclass(frozen=True)
class Knock:
    """A camera that was turned or moved during the recording.

    Attributes:
        frame: first frame after the knock.
        camera: index of the camera.
        shift_px: (2,), by how much the camera's places are moved from then on, pixels.
    """

    frame: int
    camera: int
    shift_px: Float[np.ndarray, "2"]


@dataclass(frozen=True)
class ClockStep:
    """A camera whose frames are exposed later, or earlier, than they count from some frame on.

    Attributes:
        frame: first frame after the step.
        camera: index of the camera.
        step_s: how much later they are exposed, seconds: positive where frames were lost, negative where frames were
            repeated.
    """

    frame: int
    camera: int
    step_s: float


class _Step(NamedTuple):
    """A step of a camera: `change` are pixels or seconds, `clear` how many times as large it is as usual differences.

    `explains` is the squared distance of the levels before and after by what is told of them, per dimension.
    """

    frame: int
    camera: int
    change: Float[np.ndarray, "dims"]
    clear: float
    explains: float


def find_change(views: CameraViews, all_views: CameraViews, rate_hz: float) -> Knock | ClockStep | None:
    """The clearest change of a camera; None if there is none.

    A change of one camera shows in the others, too, and most clearly in itself. Of two cameras nothing tells which it
    is: it may be the other one.

    Args:
        views: the views that say where the other cameras put the bodies.
        all_views: all that the cameras show of these bodies.
        rate_hz: frames per second of the cameras: a lost frame is one of these.
    """
    knock = _clearest_step(views, all_views, _LEAST_PX)
    late = _clearest_step(views, all_views, _LEAST_FRAMES / rate_hz, along_motion=True)
    if late is not None and (knock is None or late.explains > knock.explains):
        return ClockStep(late.frame, late.camera, float(late.change[0]))
    return None if knock is None else Knock(knock.frame, knock.camera, knock.change)


def _clearest_step(
    views: CameraViews, all_views: CameraViews, least: float, *, along_motion: bool = False
) -> _Step | None:
    """The clearest step of a camera's places, or of its time."""
    told, first = [], 0
    for counts, part in zip(views.parts(), all_views.parts(), strict=True):
        num_frames, num_drones = part.position_m.shape[:2]
        frame = np.repeat(np.arange(first, first + num_frames), num_drones)
        body = np.tile(np.arange(num_drones), num_frames)
        per_s = part.flow_px_s.reshape(-1, part.num_cameras, 2) if along_motion else None
        told.append(_of_cameras(part.places, counts.places.shown, np.stack([frame, body], axis=1), per_s))
        first += num_frames
    found: list[_Step] = []
    for camera, of_parts in enumerate(zip(*told, strict=True)):
        row, equations, shown = (np.concatenate(each) for each in zip(*of_parts, strict=True))
        found += _steps(camera, row, equations, shown, least)
    # Two cameras differ by as much: rather, one has lost frames than the other has repeated some.
    return max(found, key=lambda step: (round(step.clear, 3), step.change[0]), default=None)


#: Frame and body of each place that a camera shows, what it tells of a change of its places, as equations
#: [left | right], and whether each camera shows the body.
_Told = tuple[Int[np.ndarray, "rows 2"], Float[np.ndarray, "rows dims _"], Bool[np.ndarray, "rows cameras"]]


def _of_cameras(
    places: FittedPlaces,
    counts: Bool[np.ndarray, "rows cameras"],
    row: Int[np.ndarray, "rows 2"],
    per_s: Float[np.ndarray, "rows cameras 2"] | None,
) -> list[_Told]:
    """What is told of each camera, by all its places, and by those of the others that count."""
    told = []
    for camera in range(counts.shape[1]):
        shown = counts.copy()
        shown[:, camera] = places.shown[:, camera]
        one = replace(places, shown=shown)
        rows = np.flatnonzero(shown[:, camera] & one.determined)
        motion = None if per_s is None else per_s[rows, camera]
        told.append(_against_others(one.only(rows), row[rows], camera, motion))
    return told


def _against_others(
    used: FittedPlaces, row: Int[np.ndarray, "rows 2"], camera: int, per_s: Float[np.ndarray, "rows 2"] | None
) -> _Told:
    """What is told of one camera, by rows in which it shows something.

    The positions are eliminated: the left side is the part of the unit matrix that no position explains. A frame that
    is exposed later shows a body farther along its motion in the image, `per_s`, pixels per second.
    """
    jacobian = of_rows(np.where(used.shown[..., None, None], used.jacobian, 0.0))
    normal = jacobian.swapaxes(-1, -2) @ jacobian
    right = np.vecmat(of_rows(used.residual_px), jacobian)
    J = used.jacobian[:, camera]
    solved = J @ np.linalg.inv(normal)
    left = np.eye(2) - solved @ J.swapaxes(-1, -2)
    rest_px = (used.residual_px[:, camera] - np.matvec(solved, right))[..., None]
    if per_s is not None:
        along = per_s[:, None]
        left, rest_px = along @ left @ along.swapaxes(-1, -2), along @ rest_px
    return row, np.concatenate([left, rest_px], axis=-1), used.shown


def _steps(
    camera: int,
    row: Int[np.ndarray, "rows 2"],
    of_rows: Float[np.ndarray, "rows dims _"],
    shown: Bool[np.ndarray, "rows cameras"],
    least: float,
) -> Iterator[_Step]:
    """The clearest step of a camera, by each length of the windows, if it is one."""
    frames, number = np.unique(row[:, 0], return_inverse=True)
    equations = np.zeros((len(frames), *of_rows.shape[1:]))
    np.add.at(equations, number, of_rows)
    total = np.concatenate([np.zeros((1, *equations.shape[1:])), np.cumsum(equations, axis=0)])
    _, sets = np.unique(np.column_stack([row[:, 1], shown]), axis=0, return_inverse=True)
    for window in _WINDOWS:
        if len(frames) < 6 * window:
            break
        first = np.arange(2 * window, len(frames) - 2 * window + 1)
        change, clear = _change(total[first] - total[first - window], total[first + window] - total[first])
        usual = np.sqrt(np.median(clear) / _CHI2_MEDIAN[equations.shape[1]])
        dense = frames[first + window - 1] - frames[first - window] <= _DENSE * 2 * window
        best = int(np.where(dense, clear, 0.0).argmax())
        at = first[best]
        shortest = total[at] - total[at - _WINDOWS[0] // 2], total[at + _WINDOWS[0] // 2] - total[at]
        length2 = float(change[best] @ change[best])
        sudden = float(_change(*shortest)[0] @ change[best])
        part = _part_that_stays(change[best], of_rows, sets, int((number < at).sum()))
        wide = total[at] - total[at - 2 * window], total[at + 2 * window] - total[at]
        longer = float(_change(*wide)[0] @ change[best])
        clearly = float(np.sqrt(clear[best])) / max(float(usual), np.finfo(float).tiny)
        if (
            clearly > _CLEAR
            and length2 > least**2
            and sudden > _SUDDEN * length2
            and all(_STAYS[0] < each < _STAYS[1] for each in (part, longer / length2))
        ):
            levels = [
                _solved(each)[0] for each in (total[at] - total[at - window], total[at + window] - total[at])
            ]
            at = at - window + _likeliest_split(equations[at - window : at + window], *levels)
            explains = float(clear[best]) / len(change[best])
            yield _Step(int(frames[at]), camera, change[best], clearly, explains)


def _part_that_stays(
    change: Float[np.ndarray, "dims"],
    equations: Float[np.ndarray, "rows dims _"],
    sets: Int[np.ndarray, "rows"],
    at: int,
) -> float:
    """Part of a change that all rows before and after a step show, by what each body in a set of cameras tells of it.

    Other cameras show the body elsewhere by the errors of the rig, and another body is elsewhere.
    """
    part = whole = 0.0
    for one in np.intersect1d(sets[:at], sets[at:]).tolist():
        (level_before, before), (level_after, after) = (
            _solved(some[number == one].sum(axis=0))
            for some, number in ((equations[:at], sets[:at]), (equations[at:], sets[at:]))
        )
        told = change @ np.linalg.inv(before + after)
        part, whole = part + float(told @ (level_after - level_before)), whole + float(told @ change)
    return part / whole if whole else 0.0


def _likeliest_split(
    equations: Float[np.ndarray, "frames dims _"],
    before: Float[np.ndarray, "dims"],
    after: Float[np.ndarray, "dims"],
) -> int:
    """Number of frames before a step, from the levels before and after it."""
    costs = [
        np.einsum("fij,i,j->f", equations[..., :-1], level, level) - 2 * equations[..., -1] @ level
        for level in (before, after)
    ]
    # A step comes after a frame at least, and before one.
    return 1 + int(np.cumsum(costs[0] - costs[1])[:-1].argmin())


def _change(
    before: Float[np.ndarray, "*steps dims _"], after: Float[np.ndarray, "*steps dims _"]
) -> tuple[Float[np.ndarray, "*steps dims"], Float[np.ndarray, "*steps"]]:
    """How far apart two levels are, and the squared distance by what the equations tell of it."""
    (first_level, first), (second_level, second) = (_solved(each) for each in (before, after))
    change = second_level - first_level
    clear = np.vecdot(change, np.linalg.solve(first + second, change[..., None])[..., 0])
    return change, np.asarray(clear)


def _solved(
    equations: Float[np.ndarray, "*steps dims _"],
) -> tuple[Float[np.ndarray, "*steps dims"], Float[np.ndarray, "*steps dims dims"]]:
    """The level, and its covariance for a noise of one pixel."""
    # Two cameras tell a shift along one line only: what is hardly told counts as no shift.
    told = equations[..., :-1]
    least = 1e-3 + _LEAST_TOLD * np.trace(told, axis1=-2, axis2=-1)
    inverse = np.linalg.inv(told + least[..., None, None] * np.eye(told.shape[-1]))
    return np.matvec(inverse, equations[..., -1]), inverse

"""A camera that is knocked in mid-flight: from one frame on it shows everything elsewhere.

Each camera's places are compared with where the other cameras put the body. A knock is a step between two frames that
windows of some frames on both sides show as large as long ones do, and all frames before and after that the same
cameras show. How large a step has to be, the recording itself shows: errors that change with the attitude and the place
of a body make differences between neighbouring windows everywhere. Where another camera begins or ends to see the body,
or nobody sees the body for a time, the errors of a rig make steps of their own, which are no knocks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.tracking.camera_errors.variance_components import FittedPlaces
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
#: Smallest step, pixels of an image of 1920 columns: a calibration's own error.
_LEAST_PX = 1.5
#: Median of a squared length of two components of variance 1 (χ² distribution).
_CHI2_MEDIAN = 1.386


@dataclass(frozen=True)
class Knock:
    """A camera that was turned or moved during the recording.

    Attributes:
        frame: first frame after the knock.
        camera: index of the camera.
        shift_px: (2,), by how much the camera's places are moved from then on, pixels.
        clear: how many times as large as differences between neighbouring windows usually are.
    """

    frame: int
    camera: int
    shift_px: Float[np.ndarray, "2"]
    clear: float


def find_knock(views: CameraViews, all_views: CameraViews) -> Knock | None:
    """The clearest knock of a camera; None if there is none.

    A knock of one camera shows in the others, too, and most clearly in itself. Of two cameras nothing tells which it
    is: it may be the other one.

    Args:
        views: the views that say where the other cameras put the bodies.
        all_views: all that the cameras show of these bodies.
    """
    told, first = [], 0
    for counts, part in zip(views.parts(), all_views.parts(), strict=True):
        num_frames, num_drones = part.position_m.shape[:2]
        frame = np.repeat(np.arange(first, first + num_frames), num_drones)
        told.append(_of_cameras(part.places, counts.places.shown, frame))
        first += num_frames
    found: list[Knock] = []
    for camera, of_parts in enumerate(zip(*told, strict=True)):
        frames, equations, shown = (np.concatenate(each) for each in zip(*of_parts, strict=True))
        found += _steps(camera, frames, equations, shown)
    return max(found, key=lambda knock: knock.clear, default=None)


#: Frames in which a camera shows something, what they tell of a shift of its places, as equations [left | right], and
#: the number of bodies that each camera shows in them.
_Told = tuple[Int[np.ndarray, "frames"], Float[np.ndarray, "frames 2 3"], Float[np.ndarray, "frames cameras"]]


def _of_cameras(
    places: FittedPlaces, counts: Bool[np.ndarray, "rows cameras"], frame: Int[np.ndarray, "rows"]
) -> list[_Told]:
    told = []
    for camera in range(counts.shape[1]):
        shown = counts.copy()
        shown[:, camera] = places.shown[:, camera]
        one = replace(places, shown=shown)
        rows = np.flatnonzero(shown[:, camera] & one.determined)
        told.append(_against_others(one.only(rows), frame[rows], camera))
    return told


def _against_others(used: FittedPlaces, frame: Int[np.ndarray, "rows"], camera: int) -> _Told:
    """What is told of one camera, by rows in which it shows something.

    The positions are eliminated: the left side is the part of the unit matrix that no position explains.
    """
    weight = used.shown.astype(float)
    normal = np.einsum("rc,rcik,rcil->rkl", weight, used.jacobian, used.jacobian)
    right = np.einsum("rc,rcik,rci->rk", weight, used.jacobian, used.residual_px)
    J = used.jacobian[:, camera]
    solved = J @ np.linalg.inv(normal)
    left = np.eye(2) - solved @ J.swapaxes(-1, -2)
    rest_px = used.residual_px[:, camera] - np.matvec(solved, right)
    frames, number = np.unique(frame, return_inverse=True)
    equations = np.zeros((len(frames), 2, 3))
    np.add.at(equations, number, np.concatenate([left, rest_px[..., None]], axis=-1))
    shown = np.zeros((len(frames), used.shown.shape[1]))
    np.add.at(shown, number, weight)
    return frames, equations, shown


def _steps(
    camera: int,
    frames: Int[np.ndarray, "frames"],
    equations: Float[np.ndarray, "frames 2 3"],
    shown: Float[np.ndarray, "frames cameras"],
) -> Iterator[Knock]:
    """The clearest step of a camera, by each length of the windows, if it is one."""
    total = np.concatenate([np.zeros((1, 2, 3)), np.cumsum(equations, axis=0)])
    _, sets = np.unique(shown > 0, axis=0, return_inverse=True)
    for window in _WINDOWS:
        if len(frames) < 6 * window:
            break
        first = np.arange(2 * window, len(frames) - 2 * window + 1)
        change_px, clear = _change(total[first] - total[first - window], total[first + window] - total[first])
        usual = np.sqrt(np.median(clear) / _CHI2_MEDIAN)
        dense = frames[first + window - 1] - frames[first - window] <= _DENSE * 2 * window
        best = int(np.where(dense, clear, 0.0).argmax())
        at = first[best]
        shortest = total[at] - total[at - _WINDOWS[0] // 2], total[at + _WINDOWS[0] // 2] - total[at]
        length2 = float(change_px[best] @ change_px[best])
        sudden = float(_change(*shortest)[0] @ change_px[best])
        part = _part_that_stays(change_px[best], equations, sets, int(at))
        wide = total[at] - total[at - 2 * window], total[at + 2 * window] - total[at]
        longer = float(_change(*wide)[0] @ change_px[best])
        clearly = float(np.sqrt(clear[best])) / max(float(usual), np.finfo(float).tiny)
        if (
            clearly > _CLEAR
            and length2 > _LEAST_PX**2
            and sudden > _SUDDEN * length2
            and all(_STAYS[0] < each < _STAYS[1] for each in (part, longer / length2))
        ):
            levels_px = [
                _solved(each)[0] for each in (total[at] - total[at - window], total[at + window] - total[at])
            ]
            at = at - window + _likeliest_split(equations[at - window : at + window], *levels_px)
            yield Knock(int(frames[at]), camera, change_px[best], clearly)


def _part_that_stays(
    shift_px: Float[np.ndarray, "2"],
    equations: Float[np.ndarray, "frames 2 3"],
    sets: Int[np.ndarray, "frames"],
    at: int,
) -> float:
    """Part of a shift that all frames before and after a step show, each set of cameras by what it tells of it.

    Other cameras show the body elsewhere by the errors of the rig.
    """
    part = whole = 0.0
    for one in np.intersect1d(sets[:at], sets[at:]).tolist():
        (before_px, before), (after_px, after) = (
            _solved(some[number == one].sum(axis=0))
            for some, number in ((equations[:at], sets[:at]), (equations[at:], sets[at:]))
        )
        told = shift_px @ np.linalg.inv(before + after)
        part, whole = part + float(told @ (after_px - before_px)), whole + float(told @ shift_px)
    return part / whole if whole else 0.0


def _likeliest_split(
    equations: Float[np.ndarray, "frames 2 3"],
    before_px: Float[np.ndarray, "2"],
    after_px: Float[np.ndarray, "2"],
) -> int:
    """Number of frames before a step, from the shifts before and after it."""
    costs = [
        np.einsum("fij,i,j->f", equations[..., :2], px, px) - 2 * equations[..., 2] @ px
        for px in (before_px, after_px)
    ]
    # A step comes after a frame at least, and before one.
    return 1 + int(np.cumsum(costs[0] - costs[1])[:-1].argmin())


def _change(
    before: Float[np.ndarray, "*steps 2 3"], after: Float[np.ndarray, "*steps 2 3"]
) -> tuple[Float[np.ndarray, "*steps 2"], Float[np.ndarray, "*steps"]]:
    """How far apart two shifts are, pixels, and the squared distance by what the equations tell of it."""
    (first_px, first), (second_px, second) = (_solved(each) for each in (before, after))
    change_px = second_px - first_px
    clear = np.vecdot(change_px, np.linalg.solve(first + second, change_px[..., None])[..., 0])
    return change_px, np.asarray(clear)


def _solved(
    equations: Float[np.ndarray, "*steps 2 3"],
) -> tuple[Float[np.ndarray, "*steps 2"], Float[np.ndarray, "*steps 2 2"]]:
    """The shift, and its covariance for a noise of one pixel."""
    # Two cameras tell a shift along one line only.
    inverse = np.linalg.inv(equations[..., :2] + 1e-3 * np.eye(2))
    return np.matvec(inverse, equations[..., 2]), inverse

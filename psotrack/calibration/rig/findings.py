"""What a calibration of a rig shows, and what to do about it: figures of each camera, and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.calibration.pnp import ray_distances, refine_pnp
from psotrack.calibration.rig.adjustment import CalibratedRig
from psotrack.calibration.rig.lens_choice import say_not_compared
from psotrack.calibration.rig.views import FoundBoards
from psotrack.geometry import undistort

#: Columns and rows of cells of an image; a cell with a corner is covered.
CELLS = (8, 6)
#: Smallest fraction of an image that the board should have covered.
_COVERED = 0.5
#: Smallest number of views that a camera should share with another one.
_SHARED = 12
#: Largest standard deviation of a focal length, as a fraction of it, that needs no advice.
_FOCAL_STD = 0.005
#: A camera's views slip if the residuals are larger by this factor, and by this many pixels, than within the views.
_SLIP_FACTOR, _SLIP_PX = 2.0, 0.3
#: Largest shift of a camera's frames that is looked for, and least residual, pixels, and ratio of residuals to tell it.
_MOST_SHIFT, _SHIFT_PX, _SHIFT_FACTOR = 3, 1.0, 2.0
#: Number of views that are named.
_WORST = 5


@dataclass(frozen=True)
class CameraFigures:
    """Figures of one camera.

    Attributes:
        lens: the lens model: a number of distortion coefficients, or fisheye.
        views: number of views that count.
        corners: number of corners that count.
        found: number of corners that were found.
        rms_px: root mean square of the residuals of the corners that count, pixels.
        median_px: median residual of all corners found, pixels.
        own_median_px: median residual within the views, pixels: errors of the corners and of the lens alone.
        covered: fraction of the image in which corners were found.
        coverage: number of corners in each part of the image, row by row.
        image_size_wh: width and height of the images, pixels.
        focal_px: focal lengths along x and y, pixels.
        focal_std_px: their standard deviations.
        centre_m: the camera's centre in the world, metres.
        centre_std_m: its standard deviations.
        best_partner: the camera that shares most views, or none.
        shared: number of views shared with it.
    """

    lens: str
    views: int
    corners: int
    found: int
    rms_px: float
    median_px: float
    own_median_px: float
    covered: float
    coverage: list[list[int]]
    image_size_wh: tuple[int, int]
    focal_px: tuple[float, float]
    focal_std_px: tuple[float, float]
    centre_m: tuple[float, ...]
    centre_std_m: tuple[float, ...]
    best_partner: str
    shared: int

    @property
    def slip_px(self) -> float:
        """How far the board is from where the other cameras have it, typically, pixels."""
        return float(np.sqrt(max(self.median_px**2 - self.own_median_px**2, 0)))


def figures_of(calibrated: CalibratedRig) -> dict[str, CameraFigures]:
    """Figures of each camera, by name."""
    rig, views = calibrated.rig, calibrated.views
    others = np.where(np.eye(len(rig), dtype=bool), -1, calibrated.shared)
    rows = {}
    for index, name in enumerate(rig.names):
        used, residual = calibrated.used[index], calibrated.residual_px[index]
        found = np.isfinite(residual)
        partner = int(others[index].argmax())
        std = calibrated.lens_std[index]
        K = np.asarray(rig.cameras.K[index])
        covariance = np.diag(calibrated.centre_covariance_m2[index])
        rows[name] = CameraFigures(
            lens=str(calibrated.lens_models[index]),
            views=int(used.any(axis=-1).sum()),
            corners=int(used.sum()),
            found=int(found.sum()),
            rms_px=float(np.sqrt(np.mean(residual[used] ** 2))),
            median_px=float(np.median(residual[found])),
            own_median_px=float(np.median(calibrated.own_residual_px[index][found])),
            covered=float(coverage(calibrated, index).astype(bool).mean()),
            coverage=coverage(calibrated, index).astype(int).tolist(),
            image_size_wh=(int(views.image_size_wh[index][0]), int(views.image_size_wh[index][1])),
            focal_px=(float(K[0, 0]), float(K[1, 1])),
            focal_std_px=(float(std[0]), float(std[1])),
            centre_m=tuple(np.asarray(rig.cameras.centre_world[index]).tolist()),
            centre_std_m=tuple(np.sqrt(np.maximum(covariance, 0)).tolist()),
            best_partner=rig.names[partner] if len(views.names) > 1 else "none",
            shared=max(int(others[index, partner]), 0),
        )
    return rows


def coverage(calibrated: CalibratedRig, camera: int) -> Float[np.ndarray, "rows columns"]:
    """(rows, columns), number of corners in each cell of a camera's image."""
    pixels = calibrated.views.corners_px[camera].reshape(-1, 2)
    pixels = pixels[np.isfinite(pixels[:, 0])]
    width, height = calibrated.views.image_size_wh[camera].tolist()
    counts, _, _ = np.histogram2d(
        pixels[:, 1],
        pixels[:, 0],
        bins=(CELLS[1], CELLS[0]),
        range=((-0.5, height - 0.5), (-0.5, width - 0.5)),
    )
    return counts


def worst_views(calibrated: CalibratedRig) -> list[tuple[str, int, float]]:
    """Camera, number of the instant and median residual, pixels, of the views that fit worst."""
    seen = np.isfinite(calibrated.residual_px).any(axis=-1)
    typical = np.full(seen.shape, -1.0)
    typical[seen] = np.nanmedian(calibrated.residual_px[seen], axis=-1)
    order = np.argsort(-typical, axis=None)[: min(_WORST, int(seen.sum()))]
    return [
        (calibrated.rig.names[camera], int(calibrated.views.number[instant]), float(typical[camera, instant]))
        for camera, instant in zip(*np.unravel_index(order, seen.shape), strict=True)
    ]


def say_searched(searched: Mapping[str, tuple[int, int]]) -> list[str]:
    """A sentence on frames of long videos that were left out.

    Args:
        searched: by the name of each camera, how many frames were searched for the board, of how many.
    """
    fewer = [f"{name} {some} of {every}" for name, (some, every) in searched.items() if some < every]
    return [f"frames that were searched for the board, evenly spread: {', '.join(fewer)}"] if fewer else []


def say_print(found: FoundBoards) -> list[str]:
    """Sentences on how the board was printed and seen."""
    sentences = []
    if found.board.legacy:
        sentences.append(
            "the board has the pattern of OpenCV before version 4.6, with a marker in its first corner"
        )
    for name, mirrored, seen in zip(
        found.views.names, found.mirrored.tolist(), found.views.seen, strict=True
    ):
        if mirrored:
            sentences.append(f"{name} sees the board mirrored, in {mirrored} of {int(seen.sum())} views")
    return sentences


def find_shifts(calibrated: CalibratedRig) -> dict[str, int]:
    """Cameras whose frames fit the others much better if their numbers are changed, and by how much.

    The camera is placed again by where the other cameras have the board a few instants before and after.
    """
    shifts = {}
    for index, (name, row) in enumerate(figures_of(calibrated).items()):
        if row.median_px < _SHIFT_PX or row.median_px < _SHIFT_FACTOR * row.own_median_px:
            continue
        errors = {
            shift: _error_of(calibrated, index, shift) for shift in range(-_MOST_SHIFT, _MOST_SHIFT + 1)
        }
        best = min(errors, key=lambda shift: errors[shift])
        if best and errors[best] < errors[0] / _SHIFT_FACTOR and np.isfinite(errors[0]):
            shifts[name] = best
    return shifts


def _error_of(calibrated: CalibratedRig, index: int, shift: int) -> float:
    """Median distance x / z, y / z of corners from where a camera sees them, if its frames count more by `shift`.

    The boards are those of the other cameras, and the camera stands where they fit best; infinite for few views.
    """
    views, camera = calibrated.views, calibrated.rig.cameras[index]
    others = np.asarray(np.delete(calibrated.used, index, axis=0).any(axis=(0, 2)))
    is_one = (views.number[:, None] + shift == views.number) & views.seen[index][:, None] & others
    here, there = np.nonzero(is_one)
    if len(here) < _SHARED // 2:
        return np.inf
    T = calibrated.T_world_board[there]
    points_m = np.einsum("vij,nj->vni", T[:, :3, :3], calibrated.board.corners_m) + T[:, None, :3, 3]
    points_m = points_m.reshape(-1, 3)
    rays = undistort(camera, views.corners_px[index, here].reshape(-1, 2))
    T_cam_world = refine_pnp(points_m, rays, np.asarray(camera.T_cam_world))
    return float(np.nanmedian(ray_distances(points_m, rays, T_cam_world)))


def advise(calibrated: CalibratedRig) -> list[str]:
    """Sentences that say what to film again, and why; none where the calibration is sound."""
    rows = figures_of(calibrated)
    sentences = [say_not_compared(calibrated.not_compared)] if calibrated.not_compared else []
    sentences += [
        f"{name} shares {row.shared} views with {row.best_partner} and fewer with the others: "
        f"film more where {name} and {row.best_partner} both see the board"
        for name, row in rows.items()
        if len(rows) > 1 and row.shared < _SHARED
    ]
    named = {
        "the board was seen in small parts of the images of {}: move it into their corners": {
            name: f"{row.covered:.0%}" for name, row in rows.items() if row.covered < _COVERED
        },
        "the focal lengths of {} are not well known: tilt the board more, and film it nearer": {
            name: f"± {row.focal_std_px[0] / row.focal_px[0]:.1%}"
            for name, row in rows.items()
            if row.focal_std_px[0] > _FOCAL_STD * row.focal_px[0]
        },
        "the board is not where the other cameras see it for {}: hold it still, "
        "or check that frames of equal number are of one instant": {
            name: f"{row.slip_px:.1f} px"
            for name, row in rows.items()
            if row.median_px > _SLIP_FACTOR * row.own_median_px and row.slip_px > _SLIP_PX
        },
    }
    for words, cameras in named.items():
        if cameras:
            sentences.append(words.format(", ".join(f"{name} ({value})" for name, value in cameras.items())))
    number = int(calibrated.views.number[0])
    return sentences + [
        f"{name} fits the others better if its frame {number} is their frame {number + shift}: it shows the scene "
        f"{abs(shift)} frame{'s' if abs(shift) > 1 else ''} {'early' if shift > 0 else 'late'}; write "
        f"time_offset_s = {shift} / fps for it in a recording.toml, and pass the recording.toml instead of the videos"
        for name, shift in find_shifts(calibrated).items()
    ]

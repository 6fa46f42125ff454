"""Where a camera is, from the corners of markers of known places that it sees in one frame.

The pose of all markers together is the first start (SQPnP of Terzakis & Lourakis, ECCV 2020). Where it does not
explain most of them, some are wrong, and the poses of pairs are starts (AP3P of Ke & Roumeliotis, CVPR 2017), as in
random sample consensus (Fischler & Bolles, CACM 24(6), 1981). Markers in a plane have a second pose, turned over (IPPE
of Collins & Bartoli, IJCV 2014). `fit` makes the most likely starts precise; which pose it is, likelihoods tell,
and where the camera is expected.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations
from math import comb, log, pi

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.geometry import NEAR_M, Camera, undistort
from psotrack.inside_out.pose.equations import SeenCorners, seen_markers
from psotrack.inside_out.pose.fit import MIN_CORNERS, Fit, fit

_Start = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]

#: Pairs of markers that poses are sought from; with 40 % wrong markers a third of them is right.
_MOST_PAIRS = 55
#: Markers that single ones are tried among, too.
_FEW = 3
#: Starts that are made precise.
_MOST_FITS = 4
#: Markers that agree and are enough, whatever the others say; else half of them must.
_NO_CHANCE = 4
#: Times the stated noise that a pose of few markers may be off at the others.
_LOOSE = 15.0
#: Of the largest extent, below which markers are nearly in a plane and may have a second pose.
_NEARLY_FLAT = 0.1
#: Turned by less, a start ends at the pose that is known.
_ALIKE_RAD = np.deg2rad(1.0)
#: Logarithm of the density of a camera that is not where it is expected: once in 1000 frames it is anywhere in 1000 m³,
#: turned anyhow.
_LOG_LOST = -log(1e3 * 1e3 * 8 * pi**2)
#: Squared distance of two poses in standard deviations, below which they are one: 1 in 1000 of a χ² with 6.
_SAME = 22.5


@dataclass(frozen=True)
class PoseSettings:
    """How poses are found.

    Attributes:
        min_markers: a frame must show, 1 or more.
        noise_px: standard deviation of a corner along x and along y; residuals correct it where there are enough.
        place_m: standard deviation of what a marker's corners are off together in a frame, along each axis of the
            world; residuals correct it as well.
        map_error_m: standard deviation of a marker's place in the map along each axis, the same in every frame.
        focal_error: standard deviation of the focal length, as a share of it; the same in every frame.
    """

    min_markers: int = 4
    noise_px: float = 0.2
    place_m: float = 0.0001
    map_error_m: float = 0.0
    focal_error: float = 0.0

    def __post_init__(self) -> None:
        check_positive("noise_px", self.noise_px)
        check_positive("place_m", self.place_m)
        if self.min_markers < 1:
            raise SettingsError("min_markers", expected="at least 1", found=f"{self.min_markers}")
        for name in ("map_error_m", "focal_error"):
            if not 0 <= getattr(self, name) < 1:
                raise SettingsError(
                    name, expected="a number from 0 to below 1", found=f"{getattr(self, name):g}"
                )


@dataclass(frozen=True)
class Expected:
    """Where motion says that a camera is.

    Attributes:
        position_m: (3,), its centre, world.
        R_world_cam: (3, 3), camera to world.
        covariance: (6, 6), as in `CameraPath`.
    """

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]


@dataclass(frozen=True)
class MarkerPose:
    """A camera's pose from one frame's markers, and how sure it is.

    Attributes:
        position_m: (3,), its centre, world.
        R_world_cam: (3, 3), camera to world; camera axes x right, y down, z ahead.
        covariance: (6, 6), as in `CameraPath`: of the position along the world's axes (m) and of a small turn about the
            camera's axes (rad).
        used: (markers,), those that the pose explains.
        reprojection_px: root mean square over their good corners of the distance in the image.
        ambiguity: probability that another pose is the right one, from 0 to 1/2.
        common: (6, 3 markers + 1), of the covariance, the part that all frames have in common, as its root: what one
            standard deviation of each marker's place in the map along each axis, and of the focal length, does.
        chance: probability at most that, if no marker were what it is taken for, so many would agree.
    """

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]
    used: Bool[np.ndarray, "markers"]
    reprojection_px: float
    ambiguity: float
    common: Float[np.ndarray, "6 errors"]
    chance: float


def locate(
    corners_px: Float[np.ndarray, "markers 4 2"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    settings: PoseSettings,
    expected: Expected | None = None,
) -> MarkerPose | None:
    """The pose of a camera from one frame's markers; whole markers and single corners may be wrong.

    Args:
        corners_px: (markers, 4, 2), where they are seen.
        corners_m: (markers, 4, 3), where they are, world.
        lens: intrinsics; its pose is ignored.
        settings: how poses are found.
        expected: where motion says that the camera is; decides between poses that fit about as well.

    Returns:
        None where there are too few markers, or no pose explains them.

    Raises:
        InputError: a coordinate is not finite.
    """
    if not (np.isfinite(corners_px).all() and np.isfinite(corners_m).all()):
        raise InputError("corners", expected="finite coordinates", found="NaN or infinity")
    if len(corners_px) < settings.min_markers:
        return None
    seen = seen_markers(
        np.asarray(corners_px, np.float64),
        np.asarray(corners_m, np.float64),
        lens,
        settings.noise_px,
        settings.place_m,
        settings.map_error_m,
        settings.focal_error,
    )
    found = _poses(seen, undistort(lens, seen.corners_px))
    # That one or two of many agree is chance: any single marker has a pose that explains it.
    found = [one for one in found if one.used.sum() >= min(_NO_CHANCE, len(corners_px) / 2)]
    if not found:
        return None
    log_likely = np.array([one.log_evidence + _log_prior(one, expected) for one in found])
    best = found[log_likely.argmax()]
    odds = np.exp(np.sort(log_likely - log_likely.max()))[-2:-1].sum()
    return MarkerPose(
        best.position_m,
        best.R_world_cam,
        best.covariance,
        best.used,
        best.reprojection_px,
        float(odds / (1 + odds)),
        best.common,
        _chance(seen, best),
    )


def _chance(seen: SeenCorners, best: Fit) -> float:
    """How many sets of so many markers would agree by chance, at most: each but one falls near where it should be.

    Their sizes and how they are turned would have to agree as well; that is left out.
    """
    count, others = len(best.used), int(best.used.sum()) - 1
    near_px = _LOOSE * max(seen.noise_px, best.reprojection_px)
    area_px2 = np.prod(np.asarray(seen.lens.image_size_wh, float))
    return min(float(count * comb(count - 1, others) * min(pi * near_px**2 / area_px2, 1.0) ** others), 1.0)


def _poses(seen: SeenCorners, rays: Float[np.ndarray, "markers 4 2"]) -> list[Fit]:
    """Poses that explain the markers, or some of them, the most likely first, no two alike."""
    found = _distinct(fit(seen, *start) for start in _solved(seen.corners_m, rays, cv2.SOLVEPNP_SQPNP))
    # All that there are, or three that agree and are more than the others: no other pose explains as many as well.
    enough, near_px = min(max(3, len(rays) // 2 + 1), len(rays)), _LOOSE * seen.noise_px
    if not found or found[0].used.sum() < enough or found[0].reprojection_px > near_px:
        starts = _ranked(seen, rays, _few(seen, rays))
        found = _distinct([*found, *(fit(seen, *start, fits) for start, fits in starts)])
    return _distinct([*found, *(twin for one in found for twin in _twins(seen, rays, one))])


def _few(seen: SeenCorners, rays: Float[np.ndarray, "markers 4 2"]) -> Iterator[_Start]:
    """Poses of pairs of markers, from opposite corners of both, and of single ones where there are few."""
    count = len(rays)
    pairs = list(combinations(range(count), 2))
    if len(pairs) > _MOST_PAIRS:
        chosen = np.random.default_rng(0).permutation(len(pairs))[:_MOST_PAIRS]
        pairs = [pairs[index] for index in chosen]
    for pair in pairs:
        corners = [[one] for one in pair], [[0, 2], [1, 3]]
        yield from _solved(seen.corners_m[corners], rays[corners], cv2.SOLVEPNP_AP3P)
    for one in range(count if count <= _FEW else 0):
        yield from _solved(seen.corners_m[one], rays[one], cv2.SOLVEPNP_IPPE)


def _solved(
    corners_m: Float[np.ndarray, "*corners 3"], rays: Float[np.ndarray, "*corners 2"], method: int
) -> list[_Start]:
    """Poses that OpenCV has for corners on rays, without those that are not finite."""
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            corners_m.reshape(-1, 3), rays.reshape(-1, 2), np.eye(3), None, flags=method
        )
    except cv2.error:
        # Corners on a line, or the like.
        return []
    poses = [
        (np.asarray(cv2.Rodrigues(turn)[0]).T, shift.ravel())
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return [(-R @ t_m, R) for R, t_m in poses if np.isfinite(R).all() and np.isfinite(t_m).all()]


def _ranked(
    seen: SeenCorners, rays: Float[np.ndarray, "markers 4 2"], starts: Iterable[_Start]
) -> list[tuple[_Start, Bool[np.ndarray, "markers 4"]]]:
    """The starts that explain most, with the corners that they do, no two with the same markers."""
    starts = list(starts)
    if not starts:
        return []
    distance = _distance_px(seen, rays, starts) / (_LOOSE * seen.noise_px)
    fits = (distance < 1).sum(axis=-1) >= MIN_CORNERS
    score = np.minimum(distance, 10.0).sum(axis=(1, 2))
    chosen: list[tuple[_Start, Bool[np.ndarray, "markers 4"]]] = []
    for index in np.argsort(score, kind="stable"):
        if len(chosen) == _MOST_FITS:
            break
        used = fits[index][:, None] & (distance[index] < 1)
        if used.any() and not any((used.any(axis=1) == known.any(axis=1)).all() for _, known in chosen):
            chosen.append((starts[index], used))
    return chosen


def _distance_px(
    seen: SeenCorners, rays: Float[np.ndarray, "markers 4 2"], starts: list[_Start]
) -> Float[np.ndarray, "starts markers 4"]:
    """How far each start is off at each corner, as if the lens did not bend; infinite behind the camera."""
    position_m, R = (np.array(part) for part in zip(*starts, strict=True))
    x_cam = (seen.corners_m.reshape(-1, 3) - position_m[:, None]) @ R
    ahead = x_cam[..., 2] > NEAR_M
    places = x_cam[..., :2] / np.where(ahead, x_cam[..., 2], 1.0)[..., None]
    off_px = (places - rays.reshape(-1, 2)) * np.diag(seen.lens.K)[:2]
    return np.where(ahead, np.linalg.norm(off_px, axis=-1), np.inf).reshape(len(starts), *rays.shape[:2])


def _twins(seen: SeenCorners, rays: Float[np.ndarray, "markers 4 2"], best: Fit) -> list[Fit | None]:
    """Poses that are turned over, where the markers of the best one are nearly in a plane."""
    corners_m = seen.corners_m[best.used]
    middle_m = corners_m.mean(axis=(0, 1))
    _, extent_m, axes = np.linalg.svd((corners_m - middle_m).reshape(-1, 3), full_matrices=False)
    if extent_m[2] > _NEARLY_FLAT * extent_m[0]:
        return []
    flat = corners_m - ((corners_m - middle_m) @ axes[2])[..., None] * axes[2]
    starts = _solved(flat, rays[best.used], cv2.SOLVEPNP_IPPE)
    if not starts:
        return []
    distance_px = _distance_px(seen, rays, starts)[:, best.fits]
    near_px = _LOOSE * max(seen.noise_px, best.reprojection_px)
    return [
        fit(seen, *start, best.fits)
        for start, off_px in zip(starts, distance_px, strict=True)
        if np.sqrt(np.mean(off_px**2)) < near_px and not _alike(start, best)
    ]


def _alike(start: _Start, best: Fit) -> bool:
    # The trace of a rotation by an angle is 1 + 2 cos(angle).
    return bool(np.sum(start[1] * best.R_world_cam) > 1 + 2 * np.cos(_ALIKE_RAD))


def _distinct(fits: Iterable[Fit | None]) -> list[Fit]:
    """The most likely first, without those that are the same as a more likely one."""
    found: list[Fit] = []
    for one in sorted((one for one in fits if one is not None), key=lambda one: -one.log_evidence):
        if not any(
            _apart(one, other.position_m, other.R_world_cam, other.covariance)[0] < _SAME for other in found
        ):
            found.append(one)
    return found


def _apart(
    one: Fit,
    position_m: Float[np.ndarray, "3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    covariance: Float[np.ndarray, "6 6"],
) -> tuple[float, float]:
    """Squared distance to another pose in standard deviations of both, and the logarithm of their determinant."""
    turn = Rotation.from_matrix(R_world_cam.T @ one.R_world_cam).as_rotvec()
    apart = np.concatenate([one.position_m - position_m, turn])
    both = one.covariance + covariance
    return float(apart @ np.linalg.solve(both, apart)), float(np.linalg.slogdet(both)[1])


def _log_prior(one: Fit, expected: Expected | None) -> float:
    if expected is None:
        return 0.0
    square, log_determinant = _apart(one, expected.position_m, expected.R_world_cam, expected.covariance)
    return float(np.logaddexp(-0.5 * (square + log_determinant + 6 * log(2 * pi)), _LOG_LOST))

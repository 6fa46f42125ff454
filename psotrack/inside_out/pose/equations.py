"""Poses with their uncertainty, and the linear equations of one frame's corners from which they come.

The error of a corner has four parts. (1) Its own error. A corner is the intersection of two lines that are fitted to
edges, and each line has two corners. A line that is found turned moves its two corners in opposite directions, so that
the mean of a marker's corners is more accurate than the mean of independent errors (`_MEAN_SCALE`). (2) The error of
its marker's place, in the map and in this frame, which all corners of the marker have. (3) An inset: the white around a
black marker shines into the marker, and each corner is found too far inside. (4) The error of the focal length. Inset
and focal length are one number each for all corners of a frame: they are unknowns with a prior.

How large the first two are in a recording, the residuals of its frames tell together, because a single frame has few
markers. Both variances are chosen so that the weighted squares of the residuals are as large as their covariances let
expect (estimation of variance components: W. Förstner, Ein Verfahren zur Schätzung von Varianz- und
Kovarianzkomponenten, Allgemeine Vermessungs-Nachrichten 86, 1979). Residuals do not show all errors: a shift of all
corners in the image looks like a turn of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import SettingsError, check_positive
from psotrack.geometry import NEAR_M, Camera, cross_matrices, to_pixels_with_jacobian

#: Standard deviation of a marker's mean error by edges, as a multiple of that of independent corners. With points over
#: the fraction 0.7 of an edge, an edge's end varies 6.1 times as much by the line's turn as by its shift. Of the eight
#: unit vectors of four corners, two are the shift of the marker and two its sizes, with twice the variance of an edge's
#: shift, and four are turns of edges, with twice 6.1 times this variance: sqrt(2 / ((2 x 2 + 4 x 12.2) / 6)).
_MEAN_SCALE = 0.48
#: (8, 8), takes eight pixels of a marker to their means along x and along y.
_MEAN = np.kron(np.full((4, 4), 0.25), np.eye(2))
_OWN = np.eye(8) - (1 - _MEAN_SCALE**2) * _MEAN
#: Standard deviation of the inset, px; and prior information on the pose (none), the inset, and the focal length, whose
#: unit is its stated standard deviation.
INSET_STD_PX = 0.5
PRIOR = np.array([0.0] * 6 + [1 / INSET_STD_PX**2, 1.0])


@dataclass(frozen=True)
class SeenMarkers:
    """Markers of one frame, and the lens of the camera.

    Attributes:
        corners_px: (markers, 4, 2), measured pixels.
        rays: (markers, 4, 2), the same as normalised image coordinates.
        corners_m: (markers, 4, 3), places of the corners in the map, world, metres.
        lens: intrinsics; the pose is ignored.
        std_px: (markers,), standard deviation of a corner's own error along x and along y, pixels.
        place_m: standard deviation of a marker's place in this frame along each axis, metres.
        map_std_m: (markers,), the same of a marker's place in the map, which is the same in all frames.
        focal_error: standard deviation of the focal length, as a fraction of it.
        shift_px: standard deviation of a shift of all corners along x and along y, pixels.
    """

    corners_px: Float[np.ndarray, "markers 4 2"]
    rays: Float[np.ndarray, "markers 4 2"]
    corners_m: Float[np.ndarray, "markers 4 3"]
    lens: Camera
    std_px: Float[np.ndarray, "markers"]
    place_m: float
    map_std_m: Float[np.ndarray, "markers"]
    focal_error: float
    shift_px: float

    @property
    def inward(self) -> Float[np.ndarray, "markers 4 2"]:
        """(markers, 4, 2), unit vectors in the image from each corner into its marker."""
        to_next = _unit(np.roll(self.corners_px, -1, axis=1) - self.corners_px)
        return _unit(to_next - np.roll(to_next, 1, axis=1))


@dataclass(frozen=True)
class Equations:
    """Linear equations of the corners at a pose; those of a marker's corners that do not fit are 0 = 0.

    Attributes:
        slopes: (markers, 8, 8), derivatives of a marker's pixels (corner by corner, x and y) by the camera's position
            along the world's axes, its turn about its own axes, the inset, and the focal length.
        residual_px: (markers, 8), measured minus projected pixels.
        depth_m: (markers, 4), depths of the corners.
        own: (markers, 8, 8), covariance of the corners' own errors by detection.
        by_place: (markers, 8, 8), covariance of pixels by a variance of 1 m² of a marker's place.
        variances: (own, place, map): factor of `own`; and variances of a marker's place, in this frame, m², and in the
            map, (markers,), m².
        fits: (markers, 4), True for the corners that fit.
    """

    slopes: Float[np.ndarray, "markers 8 8"]
    residual_px: Float[np.ndarray, "markers 8"]
    depth_m: Float[np.ndarray, "markers 4"]
    own: Float[np.ndarray, "markers 8 8"]
    by_place: Float[np.ndarray, "markers 8 8"]
    variances: tuple[float, float, Float[np.ndarray, "markers"]]
    fits: Bool[np.ndarray, "markers 4"]

    @property
    def covariance(self) -> Float[np.ndarray, "markers 8 8"]:
        """(markers, 8, 8), covariance of the errors of each marker's pixels."""
        own, place_m2, map_m2 = self.variances
        return own * self.own + (place_m2 + map_m2)[:, None, None] * self.by_place

    @property
    def weight(self) -> Float[np.ndarray, "markers 8 8"]:
        """(markers, 8, 8), inverse of `covariance`; 0 for corners that do not fit."""
        unused = np.repeat(~self.fits, 2, axis=1)
        covariance = np.where(unused[:, :, None] | unused[:, None, :], np.eye(8), self.covariance)
        return np.where(unused[:, :, None] | unused[:, None, :], 0.0, np.linalg.inv(covariance))

    def solved(
        self, extra: Float[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, "8"], Float[np.ndarray, "8 8"]]:
        """Step and covariance of the unknowns by least squares.

        Args:
            extra: (2,), inset (px) and focal length (standard deviations) at which the equations were made.

        Raises:
            LinAlgError: the corners do not determine the pose.
        """
        weighted = self.slopes.swapaxes(1, 2) @ self.weight
        information = (weighted @ self.slopes).sum(axis=0) + np.diag(PRIOR)
        right = (weighted @ self.residual_px[..., None]).sum(axis=(0, 2))
        right[6:] -= PRIOR[6:] * extra
        scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        scaled = scale[:, None] * information * scale
        if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled)[0] < 1e-12:
            raise np.linalg.LinAlgError("expected markers that determine the pose")
        covariance = scale[:, None] * np.linalg.inv(scaled) * scale
        return covariance @ right, covariance

    def gain(self) -> Float[np.ndarray, "6 pixels"]:
        """(6, 8 markers), change of the pose by a change of each pixel."""
        _, covariance = self.solved(np.zeros(2))
        gains = covariance[:6] @ self.slopes.swapaxes(1, 2) @ self.weight
        return gains.swapaxes(0, 1).reshape(6, -1)

    def products(
        self, change_px: Float[np.ndarray, "markers 8 k"]
    ) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k"]]:
        """Weighted products of changes of the pixels that no pose explains, with each other and with the residuals."""
        _, covariance = self.solved(np.zeros(2))
        weighted = self.weight @ change_px
        step = covariance @ np.einsum("mpu,mpk->uk", self.slopes, weighted)
        weighted = weighted - self.weight @ self.slopes @ step
        return (
            np.einsum("mpk,mpl->kl", change_px, weighted),
            np.einsum("mpk,mp->k", weighted, self.residual_px),
        )


def linearised(
    seen: SeenMarkers,
    position_m: Float[np.ndarray, "3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    extra: Float[np.ndarray, "2"],
    fits: Bool[np.ndarray, "markers 4"],
) -> Equations:
    """Linearise the projections of all corners at a pose of the camera, an inset and a focal length (`extra`)."""
    x_cam = (seen.corners_m - position_m).reshape(-1, 3) @ R_world_cam
    depth_m = x_cam[:, 2].copy()
    # A corner behind the camera has no projection; a point in front of the camera keeps the numbers finite.
    x_cam[depth_m <= NEAR_M] = (0.0, 0.0, 1.0)
    pixels, by_shift = (np.asarray(part) for part in to_pixels_with_jacobian(seen.lens, x_cam))
    by_position = -by_shift @ R_world_cam.T
    by_extra = np.stack(
        [seen.inward.reshape(-1, 2), seen.focal_error * (pixels - seen.lens.K[:2, 2])], axis=-1
    )
    slopes = np.concatenate([by_position, by_shift @ cross_matrices(x_cam), by_extra], axis=-1)
    residual_px = seen.corners_px.reshape(-1, 2) - pixels - by_extra @ extra
    by_place = by_position.reshape(-1, 8, 3)
    return Equations(
        slopes.reshape(-1, 8, 8),
        residual_px.reshape(-1, 8),
        depth_m.reshape(-1, 4),
        seen.std_px[:, None, None] ** 2 * _OWN,
        by_place @ by_place.swapaxes(1, 2),
        (1.0, seen.place_m**2, seen.map_std_m**2),
        fits & (depth_m.reshape(-1, 4) > NEAR_M),
    )


def _unit(vectors: Float[np.ndarray, "markers 4 2"]) -> Float[np.ndarray, "markers 4 2"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


@dataclass(frozen=True)
class CornerNoise:
    """Errors of the markers in a recording.

    Attributes:
        scale: standard deviation of a corner, as a multiple of the one that its detection states.
        place_m: standard deviation of the error that all corners of a marker have in one frame, along each axis of the
            world, metres.
        shift_px: standard deviation of a shift of all corners of a frame along x and along y, pixels, such as by a
            shaken sensor. It looks like a turn of the camera, so that no residual shows it and it is not learned; in
            drawn videos it was 0.012 to 0.017 px.
    """

    scale: float = 1.0
    place_m: float = 0.0003
    shift_px: float = 0.015

    def __post_init__(self) -> None:
        for name in ("scale", "place_m", "shift_px"):
            check_positive(name, getattr(self, name))


@dataclass(frozen=True)
class PoseSettings:
    """Settings of pose estimation.

    Attributes:
        min_markers: smallest number of markers that a pose is estimated from, 1 or more.
        map_error_m: standard deviation of the position along each axis of markers whose map states none, metres; the
            same error in every frame.
        focal_error: standard deviation of the focal length, as a fraction of it; the same error in every frame.
        noise: errors of the corners; None is estimated from a recording, and is `CornerNoise()` otherwise.
    """

    min_markers: int = 4
    map_error_m: float = 0.0
    focal_error: float = 0.0
    noise: CornerNoise | None = None

    def __post_init__(self) -> None:
        if self.min_markers < 1:
            raise SettingsError("min_markers", expected="at least 1", found=f"{self.min_markers}")
        for name in ("map_error_m", "focal_error"):
            if not 0 <= getattr(self, name) < 1:
                found = f"{getattr(self, name):g}"
                raise SettingsError(name, expected="a number from 0 to below 1", found=found)


@dataclass(frozen=True)
class CameraPose:
    """Pose of a camera, with its uncertainty.

    Attributes:
        position_m: (3,), the camera's centre, world, metres.
        R_world_cam: (3, 3), camera to world; camera axes x right, y down, z ahead.
        covariance: (6, 6), as in `CameraPath`: of the position along the world's axes (m) and of a small turn about the
            camera's axes (rad).
        constant: (6, 6), the part of the covariance by errors that are the same in all frames, such as those of the map
            and of the focal length: no number of frames averages them out.
        ambiguity: probability that another pose is the right one, 0 to 1/2.
        num_markers: number of markers behind the pose.
    """

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]
    constant: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))
    ambiguity: float = 0.0
    num_markers: int = 0

    @property
    def varying(self) -> Float[np.ndarray, "6 6"]:
        """(6, 6), covariance without the constant part."""
        return self.covariance - self.constant


@dataclass(frozen=True, kw_only=True)
class MarkerPose(CameraPose):
    """Pose of a camera from the markers in one frame.

    Attributes:
        used: (markers,), True for the markers that the pose explains.
        reprojection_px: root mean square distance, over the used corners, between image and projection, pixels.
        equations: linear equations of the corners at this pose; None if unknown.
        log_evidence: logarithm of the probability density of all corners, integrated over poses near this pose.
    """

    used: Bool[np.ndarray, "markers"]
    reprojection_px: float
    equations: Equations | None = None
    log_evidence: float = 0.0

    @property
    def fits(self) -> Bool[np.ndarray, "markers 4"]:
        """(markers, 4), True for the corners that the pose explains."""
        return np.repeat(self.used[:, None], 4, axis=1) if self.equations is None else self.equations.fits


#: Weight of the variances before, as a number of residuals.
_PRIOR_RESIDUALS = 10.0
#: Number of estimates, each with the covariances by the one before. Smallest and largest deviations.
_TURNS = 20
_LEAST, _MOST = CornerNoise(0.1, 1e-5), CornerNoise(30.0, 0.05)


def estimate_noise(frames: Sequence[Equations], noise: CornerNoise) -> CornerNoise:
    """The errors by the residuals of frames.

    Args:
        frames: equations of frames at their poses.
        noise: errors with which the poses were estimated.
    """
    frames = [one for one in frames if one.fits.sum() > 4]
    factor = np.array([1.0, noise.place_m**2])
    for _ in range(_TURNS):
        sums = np.full((2, 2), _PRIOR_RESIDUALS)
        for one in frames:
            sums += _observed_and_expected(replace(one, variances=(factor[0], factor[1], one.variances[2])))
        factor = factor * sums[0] / sums[1]
        least = (_LEAST.scale / noise.scale) ** 2, _LEAST.place_m**2
        most = (_MOST.scale / noise.scale) ** 2, _MOST.place_m**2
        factor = np.clip(factor, least, most)
    own, place_m = np.sqrt(factor)
    return replace(noise, scale=float(noise.scale * own), place_m=float(place_m))


def _observed_and_expected(frame: Equations) -> Float[np.ndarray, "2 2"]:
    """Weighted squares of a frame's residuals by the corners' own errors and by the places; and their expectations."""
    try:
        step, covariance = frame.solved(np.zeros(2))
    except np.linalg.LinAlgError:
        return np.zeros((2, 2))
    weight = frame.weight
    weighted = (weight @ (frame.residual_px - frame.slopes @ step)[..., None])[..., 0]
    by_unknowns = weight @ frame.slopes
    left = weight - by_unknowns @ covariance @ by_unknowns.swapaxes(1, 2)
    own, place_m2, _ = frame.variances
    parts = own * frame.own, place_m2 * frame.by_place
    observed = [float(np.einsum("mi,mij,mj->", weighted, part, weighted)) for part in parts]
    expected = [float(np.einsum("mij,mji->", left, part)) for part in parts]
    return np.array([observed, expected])

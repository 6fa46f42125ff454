"""Linear equations of one frame's corners in the pose, with the covariance of the corners' errors.

The error of a corner has four parts. (1) Its own error. A corner is the intersection of two lines that are fitted to
edges, and each line has two corners. A line that is found turned moves its two corners in opposite directions, so that
the mean of a marker's corners is more accurate than the mean of independent errors (`_MEAN_SCALE`). (2) The error of
its marker's place, in the map and in this frame, which all corners of the marker have. (3) An inset: the white around a
black marker shines into the marker, and each corner is found too far inside. (4) The error of the focal length. Inset
and focal length are one number each for all corners of a frame: they are unknowns with a prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

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

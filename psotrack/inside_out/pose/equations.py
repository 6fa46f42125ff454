"""Linear equations of one frame's corners: in the pose, in what all corners share, and in what each marker has.

A corner's error has four parts: its own; what its whole marker hangs off its place; and, one number each for all
corners of a frame, an inset, because the white about a black marker shines into it and each corner is found inside of
where it is, and what the focal length is off. With r the residuals, J and S their derivatives by the pose with the
inset and the focal length and by a marker's place, what is minimised is

    Σ |r - J x - S d|² / own² + Σ |d|² / place² + (inset / its deviation)² + (focal length / its deviation)²,

with each marker's d eliminated as in bundle adjustment (Triggs et al., Bundle adjustment: a modern synthesis, 2000,
section 6.1). Both variances are estimated with it, from the residuals and from how many unknowns the data determine
(MacKay, Bayesian interpolation, Neural Computation 4(3), 1992), with a scaled inverse χ² prior. The principal point is
no unknown: what it is off, a turn of the camera makes up for but for what the edge of a wide image shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration import reproject
from psotrack.geometry import NEAR_M, Camera

#: Standard deviation of the inset, px.
INSET_STD_PX = 0.5
#: Information on inset and focal length before anything is seen; the latter is counted in its standard deviations.
_KNOWN = np.array([1 / INSET_STD_PX**2, 1.0])
#: Weight of what is stated of a variance, as a number of residuals.
PRIOR_RESIDUALS = 3.0
#: Variance of an unknown, as a multiple of what it were alone, beyond which the markers leave the pose free.
_FREE = 1e12


@dataclass(frozen=True)
class SeenCorners:
    """One frame's markers, and the lens that saw them.

    Attributes:
        corners_px: (markers, 4, 2).
        corners_m: (markers, 4, 3), world.
        inward: (markers, 4, 2), unit vectors in the image from each corner into its marker.
        lens: intrinsics; its pose is ignored.
        noise_px: stated standard deviation of a corner along x and along y.
        place_m: stated standard deviation of a marker's place along each axis.
        map_share: of its variance, what is due to the map, and the same in every frame.
        focal_error: stated standard deviation of the focal length, as a share of it.
    """

    corners_px: Float[np.ndarray, "markers 4 2"]
    corners_m: Float[np.ndarray, "markers 4 3"]
    inward: Float[np.ndarray, "markers 4 2"]
    lens: Camera
    noise_px: float
    place_m: float
    map_share: float
    focal_error: float


@dataclass(frozen=True)
class Noise:
    """Variances of a corner's own error and of a marker's place, and the number of residuals that each is from."""

    own_px2: float
    place_m2: float
    own_freedom: float
    place_freedom: float

    def widened(self) -> Noise:
        """With what is not known of the variances themselves: those of Student's t."""
        own, place = (freedom / (freedom - 2) for freedom in (self.own_freedom, self.place_freedom))
        return Noise(own * self.own_px2, place * self.place_m2, self.own_freedom, self.place_freedom)


@dataclass(frozen=True)
class Solution:
    """A step, the covariance of what it steps in, its length in standard deviations, and what each marker adds.

    Attributes:
        step: (8,), of position along the world's axes (m), turn about the camera's own (rad), inset (px), and focal
            length (in its stated deviations).
        covariance: (8, 8), of the same.
        length: square, in standard deviations.
        places_m2: (markers, 3, 3), covariances of the markers' places if the pose were known.
    """

    step: Float[np.ndarray, "8"]
    covariance: Float[np.ndarray, "8 8"]
    length: float
    places_m2: Float[np.ndarray, "markers 3 3"]


@dataclass(frozen=True)
class Sums:
    """The equations of the corners that count, multiplied with their transposes: 8 unknowns, and the right side.

    Attributes:
        total: (9, 9), of all.
        by_place: (markers, 3, 9), of the derivatives by each marker's place with its equations.
        count: of equations.
    """

    total: Float[np.ndarray, "9 9"]
    by_place: Float[np.ndarray, "markers 3 9"]
    count: int

    def solved(self, noise: Noise, extra: Float[np.ndarray, "2"]) -> Solution | None:
        """The step that minimises the sum; None where it leaves the pose free."""
        by_place = self.by_place / noise.own_px2
        places_m2 = np.linalg.inv(by_place[..., :3] + np.eye(3) / noise.place_m2)
        reduced = self.total / noise.own_px2 - (by_place.swapaxes(1, 2) @ places_m2 @ by_place).sum(axis=0)
        add_known(reduced, extra)
        information, toward = reduced[:8, :8], reduced[:8, 8]
        if not information.diagonal().min() > 0:
            return None
        scale = np.sqrt(information.diagonal())
        scale = scale * scale[:, None]
        try:
            inverse = np.linalg.inv(information / scale)
        except np.linalg.LinAlgError:
            return None
        # The diagonal says how many times more is unknown of each because the others are unknown too.
        if not 0 < inverse.diagonal().min() <= inverse.diagonal().max() < _FREE:
            return None
        covariance = inverse / scale
        step = covariance @ toward
        return Solution(step, (covariance + covariance.T) / 2, float(step @ toward), places_m2)

    def noise(self, solution: Solution, noise: Noise, seen: SeenCorners) -> Noise:
        """The variances from what a step leaves."""
        left = np.append(-solution.step, 1.0)
        gain = solution.places_m2 @ self.by_place / noise.own_px2
        off_m = gain @ left
        gain = gain[..., :8]
        uncertain_m2 = np.trace(solution.places_m2, axis1=1, axis2=2).sum()
        uncertain_m2 += np.sum((gain @ solution.covariance) * gain)
        of_places = max(off_m.size - uncertain_m2 / noise.place_m2, 0.0)
        of_pose = 8 - _KNOWN @ solution.covariance.diagonal()[6:]
        own_freedom = PRIOR_RESIDUALS + max(self.count - of_pose - of_places, 0.0)
        place_freedom = PRIOR_RESIDUALS + of_places
        square = left @ self.total @ left - 2 * np.sum(off_m * (self.by_place @ left))
        square += np.sum((self.by_place[..., :3] @ off_m[..., None])[..., 0] * off_m)
        return Noise(
            (PRIOR_RESIDUALS * seen.noise_px**2 + max(square, 0.0)) / own_freedom,
            (PRIOR_RESIDUALS * seen.place_m**2 + np.sum(off_m**2)) / place_freedom,
            own_freedom,
            place_freedom,
        )

    def common(self, solution: Solution, noise: Noise, map_share: float) -> Float[np.ndarray, "6 errors"]:
        """What one standard deviation of each error that all frames have in common does to the pose.

        Returns:
            (6, 3 markers + 1): by the place of each marker in the map along x, y, z, and by the focal length.
        """
        # The step is linear in what was seen, to which a marker off its place, or another focal length, adds. The
        # derivatives by a marker's place are those by the camera's, which it takes the other way.
        gain = solution.places_m2 @ self.by_place[..., :8] / noise.own_px2
        places = (gain @ solution.covariance[:, :6]).reshape(-1, 6) * np.sqrt(map_share / noise.place_m2)
        return -np.concatenate([places, solution.covariance[7:, :6]]).T


def add_known(total: Float[np.ndarray, "9 9"], extra: Float[np.ndarray, "2"]) -> None:
    """Add to equations what is known of inset and focal length before anything is seen."""
    total[[6, 7], [6, 7]] += _KNOWN
    total[6:8, 8] -= _KNOWN * extra


def log_known(extra: Float[np.ndarray, "2"]) -> float:
    """Logarithm of their density, but for a constant."""
    return -0.5 * float(_KNOWN @ extra**2)


def seen_markers(
    corners_px: Float[np.ndarray, "markers 4 2"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    noise_px: float,
    place_m: float,
    map_error_m: float = 0.0,
    focal_error: float = 0.0,
) -> SeenCorners:
    """One frame's markers, ready to be fitted; a marker is off its place by the map, and in this frame."""
    to_next = _unit(corners_px[:, [1, 2, 3, 0]] - corners_px)
    inward = _unit(to_next - to_next[:, [3, 0, 1, 2]])
    off_m = float(np.hypot(place_m, map_error_m))
    return SeenCorners(
        corners_px, corners_m, inward, lens, noise_px, off_m, (map_error_m / off_m) ** 2, focal_error
    )


def equations(
    seen: SeenCorners,
    position_m: Float[np.ndarray, "3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    extra: Float[np.ndarray, "2"],
) -> tuple[Float[np.ndarray, "markers 4 2 9"], Float[np.ndarray, "markers 4"]]:
    """Each corner's pixel by position, turn, inset and focal length, and from where it should be to where it is.

    Returns:
        (markers, 4, 2, 9), derivatives and the right side; and (markers, 4), how far ahead of the camera each is, m.
    """
    x_cam = (seen.corners_m - position_m).reshape(-1, 3) @ R_world_cam
    depth_m = x_cam[:, 2].copy()
    # What is behind has no place in the image; any place before the camera keeps the numbers finite.
    x_cam[depth_m <= NEAR_M] = (0.0, 0.0, 1.0)
    pixels, by_turn, by_shift = reproject(x_cam, np.eye(3), np.zeros(3), seen.lens)
    by_extra = np.stack(
        [seen.inward.reshape(-1, 2), seen.focal_error * (pixels - seen.lens.K[:2, 2])], axis=-1
    )
    off_px = seen.corners_px.reshape(-1, 2) - pixels - by_extra @ extra
    rows = np.concatenate([-by_shift @ R_world_cam.T, -by_turn, by_extra, off_px[..., None]], axis=-1)
    shape = seen.corners_px.shape[:2]
    return rows.reshape(*shape, 2, 9), depth_m.reshape(shape)


def summed(rows: Float[np.ndarray, "markers 4 2 9"], fits: Bool[np.ndarray, "markers 4"]) -> Sums:
    """The equations of the corners that fit."""
    chosen = (rows * fits[..., None, None]).reshape(-1, 8, 9)
    transposed = chosen.swapaxes(1, 2)
    return Sums((transposed @ chosen).sum(axis=0), transposed[:, :3] @ chosen, 2 * int(fits.sum()))


def _unit(vectors: Float[np.ndarray, "markers 4 2"]) -> Float[np.ndarray, "markers 4 2"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)

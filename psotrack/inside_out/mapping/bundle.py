"""Bundle adjustment of markers: move cameras and markers together until the squares project to where they are seen.

Triggs, McLauchlan, Hartley & Fitzgibbon (2000), "Bundle adjustment, a modern synthesis": Levenberg-Marquardt with the
cameras eliminated (`psotrack.geometry.estimation`), first with a robust loss, then with squared residuals of the
inliers. A marker is a rigid square with six unknowns, and a seventh, the logarithm of its side, where the side is
estimated. Fixed markers define the world's axes; at least one marker must be fixed.

Ink, exposure and blur move the sides of a square in its image, inwards or outwards, by a fraction of a pixel that does
not depend on the distance. The square then seems smaller and farther away, and the effect grows with the distance. The
inset, one unknown for each video, models it; an inset of 0.3 px that is left out bends a room by centimetres. Other
errors of the model are also the same in all views and would be taken for an inset. Therefore the weight of the inset's
prior is proportional to the number of views.

Where a shutter rolls, each view has six more unknowns, the motion of the camera during the frame, with the prior of a
camera that is carried or flies (Hedborg, Forssén, Felsberg & Ringaby, Rolling shutter bundle adjustment, CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration import GATE, spread_px
from psotrack.geometry.estimation import (
    NormalEquations,
    ReducedEquations,
    Step,
    cauchy_loss,
    cauchy_weight,
    covariance_from_information,
    levenberg_marquardt,
)
from psotrack.inside_out.mapping.scene import LinearisedScene, MappedScene, linearised, outward
from psotrack.inside_out.mapping.sightings import MarkerSightings

#: Relative change of the cost that ends the search; the robust search only has to find the outliers.
_LEAST_GAIN, _LEAST_GAIN_ROBUST = 1e-9, 1e-3
_MAX_STEPS = 200
#: Standard deviation of the inset, px: the effect of an error of 0.1 in the power, about 0.5, by which a camera encodes
#: light.
_INSET_PX = 0.05
#: Standard deviation of the inset among markers, px, because light and sharpness differ.
_INSET_APART_PX = 0.02
#: Smallest standard deviation of a corner, px.
_FINEST_PX = 0.01
#: Standard deviations of the motion during a frame: turn rate (rad/s) and velocity of the world's points (m/s).
_MOTION_STD = np.repeat([2.0, 4.0], 3)
#: Number of residuals of a marker in one view.
_RESIDUALS = 8


@dataclass(frozen=True)
class AdjustedMap:
    """Result of the adjustment of a scene.

    Attributes:
        scene: the adjusted scene.
        residual_px: (sightings, 4), distances in the image, also of outliers.
        used: (sightings,), False for outliers.
        covariance: (markers, 7, 7), covariance of the centre along the world's axes (m), of a small turn about them
            (rad), and of the logarithm of the side; 0 for fixed unknowns.
        noise_px: standard deviation of a corner along x and along y, estimated from the residuals.
    """

    scene: MappedScene
    residual_px: Float[np.ndarray, "sightings 4"]
    used: Bool[np.ndarray, " sightings"]
    covariance: Float[np.ndarray, "markers 7 7"]
    noise_px: float


@dataclass(frozen=True)
class _Problem:
    """Data of the adjustment.

    Attributes:
        sightings: measured corners.
        free: (unknowns,), True for the estimated ones of 7 unknowns per marker and one inset per video.
        noise_px: standard deviation of a corner along x and along y.
        columns: (sightings, 8), indices of the unknowns on which a sighting depends.
        inset_weight: (videos,), weight of the squared inset, px⁻².
    """

    sightings: MarkerSightings
    free: Bool[np.ndarray, " unknowns"]
    noise_px: float
    columns: Int[np.ndarray, "sightings 8"]
    inset_weight: Float[np.ndarray, " videos"]


@dataclass(frozen=True)
class _Bundle:
    """A scene with its residuals, `estimation.least_squares.Linearised`.

    Attributes:
        problem: data of the adjustment.
        scene: values of the unknowns.
        used: (sightings,), True for the sightings that count.
        robust: whether the loss is Cauchy's instead of the squared residual.
    """

    problem: _Problem
    scene: MappedScene
    used: Bool[np.ndarray, " sightings"]
    robust: bool

    @cached_property
    def slopes(self) -> LinearisedScene:
        """Residuals and derivatives of all sightings."""
        return linearised(self.problem.sightings, self.scene)

    @property
    def residual_px(self) -> Float[np.ndarray, "sightings 4"]:
        """(sightings, 4), distances in the image, infinite behind the camera."""
        return np.asarray(np.linalg.norm(self.slopes.off, axis=-1))

    @cached_property
    def squares(self) -> Float[np.ndarray, " sightings"]:
        """(sightings,), squared distances over a marker's four corners in standard deviations; 8 on average."""
        return np.asarray(((self.residual_px / self.problem.noise_px) ** 2).sum(axis=-1))

    @cached_property
    def cost(self) -> float:
        """Sum of the losses and of the prior of the insets."""
        # If a marker is confused with another marker, all its corners are wrong: they share one loss.
        squares = self.squares[self.used]
        loss = cauchy_loss(squares, float(_RESIDUALS)) if self.robust else squares
        prior = np.sum(self.problem.inset_weight * self.scene.inset_px**2)
        if self.scene.motion is not None:
            prior += np.sum((self.scene.motion / _MOTION_STD) ** 2)
        return float(loss.sum() + prior)

    @property
    def weights(self) -> Float[np.ndarray, " sightings"]:
        """(sightings,), weights of the residuals, px⁻²; 0 where not used."""
        squares = np.where(self.used, self.squares, 0.0)
        weight = cauchy_weight(squares, float(_RESIDUALS)) if self.robust else 1.0
        return self.used * weight / self.problem.noise_px**2

    def equations(self) -> NormalEquations:
        """Normal equations; the views are the blocks, markers and insets the shared unknowns."""
        problem, scene, weights = self.problem, self.scene, self.weights
        views, unknowns, free = problem.sightings.num_views, len(problem.free), problem.free
        size = self.slopes.by_view.shape[-1]
        kept = np.flatnonzero(weights)
        off = self.slopes.off[kept].reshape(-1, _RESIDUALS, 1)
        by_view = self.slopes.by_view[kept].reshape(-1, _RESIDUALS, size)
        by_rest = self.slopes.by_rest[kept].reshape(-1, _RESIDUALS, 8)
        view, columns, weight = problem.sightings.view[kept], problem.columns[kept], weights[kept, None, None]
        weighted_view, weighted = ((weight * part).swapaxes(1, 2) for part in (by_view, by_rest))
        of_views, view_right = np.zeros((views, size, size)), np.zeros((views, size))
        information, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        coupling = np.zeros((views, size, unknowns))
        np.add.at(of_views, view, weighted_view @ by_view)
        np.add.at(view_right, view, (weighted_view @ off)[..., 0])
        np.add.at(information, (columns[:, :, None], columns[:, None, :]), weighted @ by_rest)
        np.add.at(right, columns, (weighted @ off)[..., 0])
        np.add.at(coupling.swapaxes(1, 2), (view[:, None], columns), (weighted_view @ by_rest).swapaxes(1, 2))
        inset = np.arange(unknowns - len(scene.inset_px), unknowns)
        information[inset, inset] += problem.inset_weight
        right[inset] -= problem.inset_weight * scene.inset_px
        # A view without a used sighting stays where it is.
        of_views[np.einsum("vii->v", of_views) == 0] = np.eye(size)
        if scene.motion is not None:
            of_views[:, np.arange(6, 12), np.arange(6, 12)] += _MOTION_STD**-2.0
            view_right[:, 6:] -= scene.motion / _MOTION_STD**2
        return NormalEquations(
            information[np.ix_(free, free)], right[free], of_views, view_right, coupling[..., free]
        )

    def moved(self, step: Step) -> _Bundle:
        """Move views and markers, and change sides and insets."""
        if step.blocks is None:
            raise TypeError("expected a step with blocks, found none")
        scene, of_views = self.scene, step.blocks
        whole = np.zeros(len(self.problem.free))
        whole[self.problem.free] = step.shared
        of_markers = whole[: 7 * len(scene.ids)].reshape(-1, 7)
        moved = MappedScene(
            Rotation.from_rotvec(of_views[:, :3]).as_matrix() @ scene.R_cam_world,
            scene.t_m + of_views[:, 3:6],
            scene.ids,
            Rotation.from_rotvec(of_markers[:, 3:6]).as_matrix() @ scene.R_world_marker,
            scene.centre_m + of_markers[:, :3],
            scene.side_m * np.exp(np.clip(of_markers[:, 6], -1, 1)),
            scene.inset_px + whole[7 * len(scene.ids) :],
            None if scene.motion is None else scene.motion + of_views[:, 6:],
        )
        return replace(self, scene=moved)

    def solved(self) -> _Bundle:
        """Lower the cost from this scene."""
        # A marker behind a camera at the start has no derivative, so it does not count.
        start = replace(self, used=self.used & np.isfinite(self.squares))
        least_gain = _LEAST_GAIN_ROBUST if self.robust else _LEAST_GAIN
        found = levenberg_marquardt(start, max_steps=_MAX_STEPS, least_gain=least_gain)
        return replace(found, used=self.used)


def adjust(
    sightings: MarkerSightings,
    start: MappedScene,
    fixed: Sequence[int],
    *,
    noise_px: float = 0.3,
    estimate_sides: bool = False,
) -> AdjustedMap:
    """Adjust a scene so that its projections agree with the measured corners.

    The covariance includes noise that is independent in every frame, and errors that a marker's corner has in all
    frames and that many frames do not average out. Both are estimated from the residuals.

    Args:
        sightings: corners of markers in views; the scene has all these markers and views.
        start: approximate scene.
        fixed: ids of markers that do not move.
        noise_px: approximate standard deviation of a corner along x and along y, to find outliers at the start.
        estimate_sides: whether the sides of markers that are not fixed are unknowns.
    """
    bundle = _robust_fit(sightings, start, fixed, noise_px, estimate_sides)
    unknowns = int(bundle.problem.free.sum()) + (12 if sightings.rolls else 6) * sightings.num_views
    # The gate depends on the fit and the fit on the gate. The loop ends if they alternate.
    for _ in range(5):
        residual_px = bundle.residual_px
        sigma_px = max(_FINEST_PX, spread_px(residual_px[bundle.used].ravel(), unknowns))
        problem = replace(bundle.problem, noise_px=sigma_px)
        inliers = residual_px.max(axis=1) <= GATE * sigma_px
        before = bundle
        bundle = _Bundle(problem, before.scene, inliers, robust=False).solved()
        if (bundle.used == before.used).all():
            break
    return AdjustedMap(bundle.scene, bundle.residual_px, bundle.used, _covariance(bundle), sigma_px)


def improved(
    sightings: MarkerSightings,
    start: MappedScene,
    fixed: Sequence[int],
    *,
    noise_px: float,
    estimate_sides: bool = False,
) -> MappedScene:
    """Adjust a scene as `adjust` does, with the robust loss alone: faster, for a scene that is adjusted again."""
    return _robust_fit(sightings, start, fixed, noise_px, estimate_sides).scene


def _robust_fit(
    sightings: MarkerSightings,
    start: MappedScene,
    fixed: Sequence[int],
    noise_px: float,
    estimate_sides: bool,
) -> _Bundle:
    if sightings.rolls and start.motion is None:
        start = replace(start, motion=np.zeros((sightings.num_views, 6)))
    problem = _problem(sightings, start, fixed, noise_px, estimate_sides)
    return _Bundle(problem, start, np.ones(len(sightings.view), bool), robust=True).solved()


def _problem(
    sightings: MarkerSightings,
    start: MappedScene,
    fixed: Sequence[int],
    noise_px: float,
    estimate_sides: bool,
) -> _Problem:
    is_free = np.tile(np.array([True] * 6 + [estimate_sides]), (len(start.ids), 1))
    is_free[np.isin(start.ids, fixed)] = False
    free = np.concatenate([is_free.ravel(), np.ones(len(sightings.lenses), bool)])
    video = 7 * len(start.ids) + sightings.lens[sightings.view]
    columns = np.concatenate([7 * start.rows(sightings)[:, None] + np.arange(7), video[:, None]], axis=1)
    views = np.bincount(sightings.lens, minlength=len(sightings.lenses))
    return _Problem(sightings, free, noise_px, columns, np.maximum(views, 1) / _INSET_PX**2)


def _covariance(bundle: _Bundle) -> Float[np.ndarray, "markers 7 7"]:
    """(markers, 7, 7), covariance from noise of each frame, from lasting errors of the corners, and from the insets.

    Each part is the effect of these errors on the estimate as it is made, which has insets with a strong prior as
    unknowns: they follow a part of each error, and a camera's own inset counts as far as the prior holds them back.
    """
    problem, scene = bundle.problem, bundle.scene
    reduced = bundle.equations().reduced()
    count, size = len(scene.ids), len(reduced.information) - len(scene.inset_px)
    try:
        inverse = covariance_from_information(reduced.information)[:size]
    except np.linalg.LinAlgError:
        # A marker whose sightings are all outliers is undetermined, so no covariance is known.
        inverse = np.full((size, len(reduced.information)), np.nan)
    by_corner = inverse @ _corner_pulls(bundle, reduced)
    # All four corners of a marker move outwards by sqrt(2) px where its sides move by 1 px.
    by_marker = np.sqrt(2) * by_corner.reshape(size, count, 4, 2)[..., 0].sum(axis=-1)
    parts = [
        _lasting_px(bundle) * by_corner,
        _INSET_APART_PX * by_marker,
        _INSET_PX * inverse[:, size:] * problem.inset_weight,
    ]
    whole = np.zeros((7 * count, 7 * count))
    rows = problem.free[: 7 * count]
    whole[np.ix_(rows, rows)] = inverse[:, :size] + sum(part @ part.T for part in parts)
    return np.einsum("aiaj->aij", whole.reshape(count, 7, count, 7)).copy()


def _axes(sightings: MarkerSightings) -> Float[np.ndarray, "sightings 4 2 2"]:
    """(sightings, 4, 2, 2), unit vectors as columns: away from the middle of the marker, and across."""
    out = outward(sightings)
    out = out / np.linalg.norm(out, axis=-1, keepdims=True)
    return np.stack([out, np.stack([-out[..., 1], out[..., 0]], axis=-1)], axis=-1)


def _lasting_px(bundle: _Bundle) -> float:
    """Standard deviation of a corner's error that all frames share, along each axis, from the mean residuals.

    Each marker has eight mean residuals, and its own six unknowns explain six residuals.
    """
    problem, scene, used = bundle.problem, bundle.scene, bundle.used
    along = np.einsum("scx,scxk->sck", bundle.slopes.off[used], _axes(problem.sightings)[used])
    row = scene.rows(problem.sightings)[used]
    counts = np.bincount(row, minlength=len(scene.ids))
    sums = np.zeros((len(scene.ids), _RESIDUALS))
    np.add.at(sums, row, along.reshape(-1, _RESIDUALS))
    seen = counts > 0
    squares = (sums[seen] ** 2).sum(axis=1) / counts[seen] ** 2
    hidden = problem.free[: 7 * len(scene.ids)].reshape(-1, 7).sum(axis=1)[seen]
    white = problem.noise_px**2 / counts[seen]
    return float(np.sqrt(np.mean(np.maximum(squares / (_RESIDUALS - hidden) - white, 0.0))))


def _corner_pulls(bundle: _Bundle, reduced: ReducedEquations) -> Float[np.ndarray, "free errors"]:
    """(free, errors), right-hand sides for an error of 1 px of one corner of a marker along one axis in all frames.

    There are eight errors per marker. The views are eliminated.
    """
    problem, scene, weights = bundle.problem, bundle.scene, bundle.weights
    sightings, kept = problem.sightings, np.flatnonzero(weights)
    axes = _axes(sightings)[kept] * weights[kept, None, None, None]
    size = bundle.slopes.by_view.shape[-1]
    by_view = np.einsum("scxf,scxk->sfck", bundle.slopes.by_view[kept], axes).reshape(
        len(kept), size, _RESIDUALS
    )
    by_rest = np.einsum("scxf,scxk->sfck", bundle.slopes.by_rest[kept], axes).reshape(
        len(kept), 8, _RESIDUALS
    )
    errors = _RESIDUALS * scene.rows(sightings)[kept][:, None] + np.arange(_RESIDUALS)
    of_views = np.zeros((sightings.num_views, _RESIDUALS * len(scene.ids), size))
    of_views[sightings.view[kept][:, None], errors] = by_view.swapaxes(1, 2)
    pulls = np.zeros((len(problem.free), _RESIDUALS * len(scene.ids)))
    np.add.at(pulls, (problem.columns[kept][:, :, None], errors[:, None, :]), by_rest)
    return pulls[problem.free] - np.tensordot(reduced.gain, of_views, axes=([0, 1], [0, 2]))

"""Bundle adjustment of markers: cameras and markers are moved together until squares are where they are seen.

Triggs, McLauchlan, Hartley & Fitzgibbon (2000), "Bundle adjustment, a modern synthesis": Levenberg-Marquardt with the
cameras eliminated by the Schur complement, a Cauchy loss by reweighting, and once more without on what agrees. A marker
is a rigid square: six unknowns, and a seventh, the logarithm of its side, where that is sought. Markers that are fixed
say where the world is; at least one must be.

Ink, exposure and blur move the sides of a square in its image, inwards or outwards, by a fraction of a pixel that is
the same near and far: a square seems smaller and farther away than it is, the more so the farther. That inset, one for
each video, is sought as well; one of 0.3 px that is unheeded bends a room by centimetres. What else is wrong with a
model is wrong in all views, and takes itself for an inset: so its prior counts as often as there are views.
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration import GATE, spread_px
from psotrack.inside_out.mapping.scene import MappedScene, linearised, outward, residuals_px
from psotrack.inside_out.mapping.sightings import MarkerSightings

#: Relative change of the cost that ends the search; of the robust one, which only finds the outliers.
_SETTLED, _SETTLED_ROBUST = 1e-9, 1e-3
_MOST_STEPS = 100
#: Standard deviation of the inset: grey levels that are the light to the power of 0.4 to 0.6, where 0.5 was thought.
_INSET_PX = 0.05
#: By how much it differs among markers, as light and sharpness do.
_INSET_APART_PX = 0.02
#: What corners are never better than, in pixels.
_FINEST_PX = 0.01


@dataclass(frozen=True)
class AdjustedMap:
    """A scene that the images agree with.

    Attributes:
        scene: adjusted.
        residual_px: (sightings, 4), distances in the image, outliers too.
        used: (sightings,), False for outliers.
        covariance: (markers, 7, 7), of the centre along the world's axes (m), of a small turn about them (rad), and of
            the logarithm of the side; 0 for what is fixed.
        noise_px: standard deviation of a corner along x and along y, as the residuals say.
    """

    scene: MappedScene
    residual_px: Float[np.ndarray, "sightings 4"]
    used: Bool[np.ndarray, " sightings"]
    covariance: Float[np.ndarray, "markers 7 7"]
    noise_px: float


@dataclass(frozen=True)
class _Problem:
    sightings: MarkerSightings
    #: (unknowns,), which of 7 unknowns per marker, and of one per video, are sought.
    free: Bool[np.ndarray, " unknowns"]
    noise_px: float
    #: (sightings, 8), of the unknowns, that a sighting depends on.
    columns: Int[np.ndarray, "sightings 8"]
    #: (videos,), weight of the squared inset.
    held: Float[np.ndarray, " videos"]


def adjust(
    sightings: MarkerSightings,
    start: MappedScene,
    fixed: Ordered[int],
    *,
    noise_px: float = 0.3,
    estimate_sides: bool = False,
) -> AdjustedMap:
    """The scene that explains what is seen.

    The covariance is that of the noise that the residuals tell of: of noise that is new in every frame, and of errors
    that a marker's corner has in all of them, which many frames do not take away.

    Args:
        sightings: of markers that are all in the scene, in views that are all in it.
        start: near the answer.
        fixed: ids of markers that stay where they are.
        noise_px: standard deviation of a corner along x and along y, about: it tells outliers at the start.
        estimate_sides: of the markers that are not fixed.
    """
    problem = _problem(sightings, start, fixed, noise_px, estimate_sides)
    everything = np.ones(len(sightings.view), bool)
    scene = _solved(problem, start, everything, robust=True)
    residual_px = residuals_px(sightings, scene)
    used = everything
    unknowns = int(problem.free.sum()) + 6 * sightings.num_views
    # The gate moves with the fit and the fit with the gate; what swings to and fro ends somewhere.
    for _ in range(5):
        sigma_px = max(_FINEST_PX, spread_px(residual_px[used].ravel(), unknowns))
        problem = replace(problem, noise_px=sigma_px)
        within = residual_px.max(axis=1) <= GATE * sigma_px
        before, used = used, within
        scene = _solved(problem, scene, used, robust=False)
        residual_px = residuals_px(sightings, scene)
        if (used == before).all():
            break
    return AdjustedMap(scene, residual_px, used, _covariance(problem, scene, used), sigma_px)


def improved(
    sightings: MarkerSightings,
    start: MappedScene,
    fixed: Ordered[int],
    *,
    noise_px: float,
    estimate_sides: bool = False,
) -> MappedScene:
    """As `adjust`, with the robust loss alone: good enough to go on from."""
    problem = _problem(sightings, start, fixed, noise_px, estimate_sides)
    return _solved(problem, start, np.ones(len(sightings.view), bool), robust=True)


def _problem(
    sightings: MarkerSightings, start: MappedScene, fixed: Ordered[int], noise_px: float, estimate_sides: bool
) -> _Problem:
    sought = np.tile(np.array([True] * 6 + [estimate_sides]), (len(start.ids), 1))
    sought[np.isin(start.ids, fixed)] = False
    free = np.concatenate([sought.ravel(), np.ones(len(sightings.lenses), bool)])
    video = 7 * len(start.ids) + sightings.lens[sightings.view]
    columns = np.concatenate([7 * start.rows(sightings)[:, None] + np.arange(7), video[:, None]], axis=1)
    views = np.bincount(sightings.lens, minlength=len(sightings.lenses))
    return _Problem(sightings, free, noise_px, columns, np.maximum(views, 1) / _INSET_PX**2)


@dataclass(frozen=True)
class _Normal:
    """The normal equations: of the views, of what else is sought, and what couples the two."""

    views: Float[np.ndarray, "views 6 6"]
    view_right: Float[np.ndarray, "views 6"]
    rest: Float[np.ndarray, "free free"]
    right: Float[np.ndarray, " free"]
    mixed: Float[np.ndarray, "views 6 free"]


def _normal(problem: _Problem, scene: MappedScene, weights: Float[np.ndarray, " sightings"]) -> _Normal:
    views, unknowns, free = problem.sightings.num_views, len(problem.free), problem.free
    kept = np.flatnonzero(weights)
    slopes = linearised(problem.sightings, scene)
    off, by_view = slopes.off[kept].reshape(-1, 8, 1), slopes.by_view[kept].reshape(-1, 8, 6)
    by_rest = slopes.by_rest[kept].reshape(-1, 8, 8)
    view, columns, weight = problem.sightings.view[kept], problem.columns[kept], weights[kept, None, None]
    weighted_view, weighted = ((weight * part).swapaxes(1, 2) for part in (by_view, by_rest))
    of_views, view_right = np.zeros((views, 6, 6)), np.zeros((views, 6))
    rest, right, mixed = np.zeros((unknowns, unknowns)), np.zeros(unknowns), np.zeros((views, 6, unknowns))
    np.add.at(of_views, view, weighted_view @ by_view)
    np.add.at(view_right, view, (weighted_view @ off)[..., 0])
    np.add.at(rest, (columns[:, :, None], columns[:, None, :]), weighted @ by_rest)
    np.add.at(right, columns, (weighted @ off)[..., 0])
    np.add.at(mixed.swapaxes(1, 2), (view[:, None], columns), (weighted_view @ by_rest).swapaxes(1, 2))
    inset = np.arange(unknowns - len(scene.inset_px), unknowns)
    rest[inset, inset] += problem.held
    right[inset] -= problem.held * scene.inset_px
    # A view of which nothing is used stays where it is.
    of_views[np.einsum("vii->v", of_views) == 0] = np.eye(6)
    return _Normal(of_views, view_right, rest[np.ix_(free, free)], right[free], mixed[..., free])


def _reduced(
    normal: _Normal, damping: float
) -> tuple[Float[np.ndarray, "views 6 6"], Float[np.ndarray, "free free"], Float[np.ndarray, " free"]]:
    """The views' inverses, and the equations that are left when the views are eliminated (the Schur complement)."""
    inverse = np.linalg.inv(normal.views * (1 + damping * np.eye(6)))
    flat = normal.mixed.reshape(-1, normal.mixed.shape[-1])
    back = (inverse @ normal.mixed).reshape(flat.shape)
    reduced = normal.rest * (1 + damping * np.eye(len(normal.rest))) - flat.T @ back
    return inverse, (reduced + reduced.T) / 2, normal.right - back.T @ normal.view_right.reshape(-1)


def _moved(problem: _Problem, scene: MappedScene, normal: _Normal, damping: float) -> MappedScene:
    inverse, reduced, right = _reduced(normal, damping)
    scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    # A ridge that changes nothing, but where there is nothing.
    step = (
        np.linalg.solve(reduced / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)), right / scale) / scale
    )
    of_views = np.einsum("vij,vj->vi", inverse, normal.view_right - normal.mixed @ step)
    whole = np.zeros(len(problem.free))
    whole[problem.free] = step
    of_markers = whole[: 7 * len(scene.ids)].reshape(-1, 7)
    return MappedScene(
        Rotation.from_rotvec(of_views[:, :3]).as_matrix() @ scene.R_cam_world,
        scene.t_m + of_views[:, 3:],
        scene.ids,
        Rotation.from_rotvec(of_markers[:, 3:6]).as_matrix() @ scene.R_world_marker,
        scene.centre_m + of_markers[:, :3],
        scene.side_m * np.exp(np.clip(of_markers[:, 6], -1, 1)),
        scene.inset_px + whole[7 * len(scene.ids) :],
    )


def _solved(
    problem: _Problem, scene: MappedScene, used: Bool[np.ndarray, " sightings"], *, robust: bool
) -> MappedScene:
    """Levenberg-Marquardt from a scene; damping grows where a step does not help."""
    damping, squares = 1e-4, _squares(problem, scene)
    # What is behind a camera at the start has no slope, and no say.
    used = used & np.isfinite(squares)
    for _ in range(_MOST_STEPS):
        weights = used / (1 + np.where(used, squares, 0.0) / 8 if robust else 1.0) / problem.noise_px**2
        normal, cost = _normal(problem, scene, weights), _cost(problem, squares[used], scene, robust)
        for _ in range(10):
            tried = _moved(problem, scene, normal, damping)
            tried_squares = _squares(problem, tried)
            tried_cost = _cost(problem, tried_squares[used], tried, robust)
            if tried_cost <= cost:
                break
            damping = max(damping, 1e-7) * 10
        else:
            return scene
        scene, squares = tried, tried_squares
        damping *= 0.1
        if cost - tried_cost <= (_SETTLED_ROBUST if robust else _SETTLED) * cost:
            return scene
    return scene


def _squares(problem: _Problem, scene: MappedScene) -> Float[np.ndarray, " sightings"]:
    """Squared distances over a marker's four corners, in units of the noise; 8 on average."""
    return ((residuals_px(problem.sightings, scene) / problem.noise_px) ** 2).sum(axis=-1)


def _cost(
    problem: _Problem, squares: Float[np.ndarray, " sightings"], scene: MappedScene, robust: bool
) -> float:
    # All four corners of a marker are wrong together, where it is another marker: they share their loss.
    loss = 8 * np.log1p(squares / 8) if robust else squares
    return float(loss.sum() + np.sum(problem.held * scene.inset_px**2))


def _covariance(
    problem: _Problem, scene: MappedScene, used: Bool[np.ndarray, " sightings"]
) -> Float[np.ndarray, "markers 7 7"]:
    """Of noise that is new in every frame, of errors that a marker's corner has in all of them, and of the inset."""
    weights = used / problem.noise_px**2
    normal = _normal(problem, scene, weights)
    of_views, reduced, _ = _reduced(normal, damping=0.0)
    count, sought = len(scene.ids), len(reduced) - len(scene.inset_px)
    of_markers, by_inset = reduced[:sought, :sought], reduced[:sought, sought:]
    scale = np.sqrt(np.diag(of_markers))
    inverse = np.linalg.inv(of_markers / np.outer(scale, scale)) / np.outer(scale, scale)
    by_alike = inverse @ _alike_pulls(problem, scene, weights, of_views, normal.mixed)[:sought]
    # Outward for all four corners of a marker, by root two where its sides move by one.
    apart = np.sqrt(2) * by_alike.reshape(sought, count, 4, 2)[..., 0].sum(axis=-1)
    common = inverse @ by_inset
    parts = [
        _alike_px(problem, scene, used) * by_alike,
        _INSET_APART_PX * apart,
        _INSET_PX * common,
    ]
    whole = np.zeros((7 * count, 7 * count))
    rows = problem.free[: 7 * count]
    whole[np.ix_(rows, rows)] = inverse + sum(part @ part.T for part in parts)
    return np.einsum("aiaj->aij", whole.reshape(count, 7, count, 7)).copy()


def _axes(sightings: MarkerSightings) -> Float[np.ndarray, "sightings 4 2 2"]:
    """Columns: outward from the middle of the marker, and across."""
    out = outward(sightings)
    out = out / np.linalg.norm(out, axis=-1, keepdims=True)
    return np.stack([out, np.stack([-out[..., 1], out[..., 0]], axis=-1)], axis=-1)


def _alike_px(problem: _Problem, scene: MappedScene, used: Bool[np.ndarray, " sightings"]) -> float:
    """Standard deviation of what a corner is off in all frames, along each axis, from the means of residuals.

    Of the eight of a marker its own six unknowns hide six.
    """
    off = linearised(problem.sightings, scene).off[used]
    along = np.einsum("scx,scxk->sck", off, _axes(problem.sightings)[used]).reshape(-1, 8)
    row = scene.rows(problem.sightings)[used]
    counts = np.bincount(row, minlength=len(scene.ids))
    sums = np.zeros((len(scene.ids), 8))
    np.add.at(sums, row, along)
    seen = counts > 0
    squares = (sums[seen] ** 2).sum(axis=1) / counts[seen] ** 2
    hidden = problem.free[: 7 * len(scene.ids)].reshape(-1, 7).sum(axis=1)[seen]
    white = problem.noise_px**2 / counts[seen]
    return float(np.sqrt(np.mean(np.maximum(squares / (8 - hidden) - white, 0.0))))


def _alike_pulls(
    problem: _Problem,
    scene: MappedScene,
    weights: Float[np.ndarray, " sightings"],
    inverse_of_views: Float[np.ndarray, "views 6 6"],
    mixed: Float[np.ndarray, "views 6 free"],
) -> Float[np.ndarray, "free alike"]:
    """How errors of 1 px that a marker's corner has in all frames, along each axis, pull on what is sought."""
    sightings, kept = problem.sightings, np.flatnonzero(weights)
    slopes, axes = linearised(sightings, scene), _axes(sightings)[kept] * weights[kept, None, None, None]
    by_view = np.einsum("scxf,scxk->sfck", slopes.by_view[kept], axes).reshape(len(kept), 6, 8)
    by_rest = np.einsum("scxf,scxk->sfck", slopes.by_rest[kept], axes).reshape(len(kept), 8, 8)
    alike = 8 * scene.rows(sightings)[kept][:, None] + np.arange(8)
    of_views = np.zeros((sightings.num_views, 8 * len(scene.ids), 6))
    of_views[sightings.view[kept][:, None], alike] = by_view.swapaxes(1, 2)
    pulls = np.zeros((len(problem.free), 8 * len(scene.ids)))
    np.add.at(pulls, (problem.columns[kept][:, :, None], alike[:, None, :]), by_rest)
    through = np.einsum("vij,vaj->via", inverse_of_views, of_views).reshape(-1, pulls.shape[1])
    return pulls[problem.free] - mixed.reshape(-1, mixed.shape[-1]).T @ through

"""Bundle adjustment of markers: move cameras and markers together until the squares project to where they are seen.

The views are the blocks of `calibration.bundle`, first with a robust loss, then with squared residuals of the inliers.
A marker is a rigid square with six unknowns, and a seventh, the logarithm of its side, where the side is estimated.
Fixed markers define the world's axes; at least one marker must be fixed.

Ink, exposure and blur move the sides of a square in its image, inwards or outwards, by a fraction of a pixel that does
not depend on the distance. The square then seems smaller and farther away, and the effect grows with the distance. The
inset, one unknown for each video, models it; an inset of 0.3 px that is left out bends a room by centimetres. Other
errors of the model are also the same in all views and would be taken for an inset. Therefore the weight of the inset's
prior is proportional to the number of views.

Most cameras expose the rows of an image one after the other. The rows of a frame then show the same motion as the poses
of this and the next frame. Where they certainly do, each view has six more unknowns, the motion of the camera during
the frame, as large as the motion between frames lets expect. Where they do not, the shutter is taken for a global one:
errors of the lens look like a motion that no pose shows.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.calibration import GATE, Bundle, BundleProblem, BundleState, KnownLens, spread_px, summed
from psotrack.geometry.estimation import covariance_from_information
from psotrack.inside_out.mapping.sightings import MarkerSightings, outward
from psotrack.inside_out.marker_map import SQUARE, PlacedMarker

#: Standard deviation of the inset, px: the effect of an error of 0.1 in the power, about 0.5, by which a camera encodes
#: light.
_INSET_PX = 0.05
#: Standard deviation of the inset among markers, px, because light and sharpness differ.
_INSET_APART_PX = 0.02
#: Smallest standard deviation of a corner, px.
_FINEST_PX = 0.01
#: Largest number of adjustments.
_MOST_ROUNDS = 5
#: Standard deviation of the turn during half a frame while it is not known whether the shutter rolls, radians.
_SHAKEN_RAD = 0.05
#: Fewest pairs of consecutive frames that tell whether a shutter rolls, and the ratio of the estimated readout to its
#: standard deviation from which on it does.
_FEWEST_PAIRS, _SURE = 5, 4.0
#: Number of pairs that follow one another whose errors are alike.
_ALIKE = 5
#: Standard deviation of a motion that is none, radians and metres.
_STILL = 1e-7
#: Number of residuals of a marker in one view.
_RESIDUALS = 8


def adjusted_roughly(
    sightings: MarkerSightings,
    markers: Mapping[int, PlacedMarker],
    T_cam_world: Float[np.ndarray, "views 4 4"],
    fixed: Collection[int],
    *,
    noise_px: float,
    estimate_sides: bool = False,
) -> Bundle:
    """Markers and views whose projections agree with most of the measured corners, by a robust loss.

    Args:
        sightings: corners of these markers in these views.
        markers: approximate markers, all that the sightings have.
        T_cam_world: approximate poses.
        fixed: ids of markers that do not move.
        noise_px: approximate standard deviation of a corner along x and along y.
        estimate_sides: whether the sides of markers that are not fixed are unknowns.
    """
    ids, videos = np.array(sightings.ids), len(sightings.lenses)
    free = np.tile(np.array([True] * 6 + [estimate_sides]), (len(ids), 1))
    free[np.isin(ids, list(fixed))] = False
    views = np.bincount(sightings.lens, minlength=videos)
    problem = BundleProblem(
        models=tuple(map(KnownLens, sightings.lenses)),
        priors=tuple((np.zeros(1), np.array([[max(count, 1) / _INSET_PX**2]])) for count in views.tolist()),
        corners_m=SQUARE,
        lens=sightings.lens[sightings.view],
        camera=sightings.view,
        target=np.searchsorted(ids, sightings.marker),
        corners_px=sightings.corners_px,
        noise_px=np.full(len(sightings.view), noise_px),
        free_lens=(np.ones(1, bool),) * videos,
        free_camera=np.ones(sightings.num_views, bool),
        free_target=free,
        cameras_are_blocks=True,
        is_whole=True,
        inward=-outward(sightings),
    )
    targets = np.array([markers[marker].T_world_marker for marker in sightings.ids])
    sides = np.array([markers[marker].side_m for marker in sightings.ids])
    state = BundleState((np.zeros(1),) * videos, T_cam_world, targets, sides)
    return Bundle(problem, state, np.ones(sightings.corners_px.shape[:2], bool), is_robust=True).solved()


def markers_of(sightings: MarkerSightings, bundle: Bundle) -> dict[int, PlacedMarker]:
    """The markers of a bundle, by id."""
    state = bundle.state
    rows = zip(sightings.ids, state.T_world_target, state.size.tolist(), strict=True)
    return {marker: PlacedMarker(T, side_m) for marker, T, side_m in rows}


def adjust(sightings: MarkerSightings, bundle: Bundle) -> Bundle:
    """Adjust a rough bundle without outliers, and with the motion during the frames where shutters roll.

    The noise of its problem is the standard deviation of a corner along x and along y by the residuals.
    """
    unknowns = bundle.problem.size + 6 * sightings.num_views
    bundle = _without_outliers(bundle, unknowns)
    rolling = _with_motion(sightings, bundle)
    if rolling is not None:
        moved = _without_outliers(rolling, unknowns + 6 * sightings.num_views)
        bundle = moved if moved.problem.noise_px[0] < bundle.problem.noise_px[0] else bundle
    return bundle


def _without_outliers(bundle: Bundle, unknowns: int) -> Bundle:
    """The adjustment with squared residuals without outliers."""
    # The gate depends on the fit and the fit on the gate. The loop ends if they alternate.
    for _ in range(_MOST_ROUNDS):
        before, distance_px = bundle, bundle.distance_px
        sigma_px = max(_FINEST_PX, spread_px(distance_px[bundle.used], unknowns))
        inliers = distance_px.max(axis=1, keepdims=True) <= GATE * sigma_px
        problem = replace(bundle.problem, noise_px=np.full(len(inliers), sigma_px))
        used = np.broadcast_to(inliers, distance_px.shape)
        bundle = replace(bundle, problem=problem, used=used, is_robust=False).solved()
        if (bundle.used == before.used).all():
            break
    return bundle


def _with_motion(sightings: MarkerSightings, bundle: Bundle) -> Bundle | None:
    """The bundle with a motion during each frame of a rolling shutter; None if no shutter certainly rolls.

    A view's rows show the motion m during half a frame with the information L. The next view shows the motion x in a
    whole frame. The readout, in frames, is 2 r of the least squares solution of m = r x, weighted by L, over all pairs
    of consecutive views; its variance is that of the sums over neighbouring pairs, whose errors are alike (Liang &
    Zeger, Longitudinal data analysis using generalized linear models, Biometrika 73(1), 1986).
    """
    # Views that the next frame of the same video follows.
    step_s = np.where(np.diff(sightings.lens) == 0, np.diff(sightings.time_s), np.inf)
    least_s = np.full(len(sightings.lenses), np.inf)
    np.minimum.at(least_s, sightings.lens[:-1], step_s)
    first = np.flatnonzero(step_s < 1.5 * least_s[sightings.lens[:-1]])
    if len(first) < _FEWEST_PAIRS:
        return None
    height = np.array([float(lens.image_size_wh[1]) for lens in sightings.lenses])[bundle.problem.lens]
    T = bundle.state.T_cam_world
    centre_m = bundle.state.T_world_target[bundle.problem.target, :3, 3]
    at = T[bundle.problem.camera]
    depth_m = float(np.median(np.vecdot(at[:, 2, :3], centre_m) + at[:, 2, 3]))
    wide = np.zeros((len(T), 6)) + np.repeat([_SHAKEN_RAD, _SHAKEN_RAD * depth_m], 3)
    row = (2 * sightings.corners_px[..., 1] + 1) / height[:, None] - 1
    problem = replace(bundle.problem, row=row, motion_std=wide)
    moving = replace(
        bundle, problem=problem, state=replace(bundle.state, motion=np.zeros((len(T), 6)))
    ).solved()
    blocks = moving.equations().block_information
    if blocks is None or moving.state.motion is None:
        raise TypeError("expected a bundle with motion, found none")
    motion, T = moving.state.motion[first], moving.state.T_cam_world
    prior = wide[0] ** -2
    of_pose, between, own = (
        blocks[first, :6, :6],
        blocks[first, :6, 6:],
        blocks[first, 6:, 6:] - np.diag(prior),
    )
    information = own - between.swapaxes(-1, -2) @ np.linalg.solve(of_pose, between)
    step = T[first + 1] @ np.linalg.inv(T[first])
    shown = np.concatenate([Rotation.from_matrix(step[:, :3, :3]).as_rotvec(), step[:, :3, 3]], axis=1)
    # The prior holds the motion back: L times the motion without a prior.
    right = np.vecdot(shown, np.matvec(information, motion) + prior * motion)
    weight = np.vecdot(shown, np.matvec(information, shown))
    std, rolls = np.full((len(T), 6), _STILL), False
    for video in range(len(sightings.lenses)):
        pairs = sightings.lens[first] == video
        if pairs.sum() < _FEWEST_PAIRS:
            continue
        ratio = right[pairs].sum() / weight[pairs].sum()
        rest = right[pairs] - ratio * weight[pairs]
        sums = np.add.reduceat(rest, np.arange(0, len(rest), _ALIKE))
        spread = np.linalg.norm(sums) / weight[pairs].sum()
        if abs(ratio) > _SURE * spread:
            size = np.sqrt((shown[pairs].reshape(-1, 2, 3) ** 2).mean(axis=(0, 2)))
            std[sightings.lens == video] = np.maximum(abs(ratio) * np.repeat(size, 3), _STILL)
            rolls = True
    return replace(moving, problem=replace(problem, motion_std=std)) if rolls else None


def covariance_of(sightings: MarkerSightings, bundle: Bundle) -> Float[np.ndarray, "markers 7 7"]:
    """(markers, 7, 7), covariance of the markers, in the order of increasing ids.

    Of the centre along the world's axes (m), of a small turn about them (rad), and of the logarithm of the side; 0 for
    fixed unknowns. Errors are noise that is independent in every frame, errors that a corner keeps in all frames, both
    estimated from the residuals, and insets. Each part is the effect of these errors on the estimate as it is made,
    which has insets with a strong prior as unknowns: they follow a part of each error, and a camera's own inset counts
    as far as the prior holds them back.
    """
    problem, videos, count = bundle.problem, len(sightings.lenses), len(bundle.problem.free_target)
    reduced = bundle.equations().reduced()
    try:
        inverse = covariance_from_information(reduced.information)
    except np.linalg.LinAlgError:
        # A marker whose sightings are all outliers is undetermined, so no covariance is known.
        inverse = np.full_like(reduced.information, np.nan)
    # Unit vectors as columns, (sightings, 4, 2, 2): away from the middle of the marker, and across.
    out = outward(sightings)
    out = out / np.linalg.norm(out, axis=-1, keepdims=True)
    axes = np.stack([out, np.stack([-out[..., 1], out[..., 0]], axis=-1)], axis=-1)
    by_corner = (inverse @ _pulls(bundle, axes, reduced.gain))[videos:]
    # All four corners of a marker move outwards by sqrt(2) px where its sides move by 1 px.
    by_marker = np.sqrt(2) * by_corner.reshape(-1, count, 4, 2)[..., 0].sum(axis=-1)
    weight = np.array([information[0, 0] for _, information in problem.priors])
    parts = [
        _kept_px(bundle, axes) * by_corner,
        _INSET_APART_PX * by_marker,
        _INSET_PX * inverse[videos:, :videos] * weight,
    ]
    whole = np.zeros((7 * count, 7 * count))
    rows = problem.free_target.ravel()
    whole[np.ix_(rows, rows)] = inverse[videos:, videos:] + sum(part @ part.T for part in parts)
    centre_first = [3, 4, 5, 0, 1, 2, 6]
    of_markers = np.einsum("aiaj->aij", whole.reshape(count, 7, count, 7))
    return of_markers[:, centre_first][:, :, centre_first]


def _kept_px(bundle: Bundle, axes: Float[np.ndarray, "sightings 4 2 2"]) -> float:
    """Standard deviation of the error that a corner keeps in all frames, along each axis, from the mean residuals.

    Each marker has eight mean residuals, and its own six unknowns explain six residuals.
    """
    used, target = bundle.used[:, 0], bundle.problem.target
    along = np.einsum("scx,scxk->sck", bundle.slopes[0][used], axes[used]).reshape(-1, _RESIDUALS)
    counts = np.bincount(target[used], minlength=len(bundle.problem.free_target))
    sums = summed(along, (target[used, None], np.arange(_RESIDUALS)), (len(counts), _RESIDUALS))
    seen = counts > 0
    squares = (sums[seen] ** 2).sum(axis=1) / counts[seen] ** 2
    white = bundle.problem.noise_px[0] ** 2 / counts[seen]
    explained = bundle.problem.free_target.sum(axis=1)[seen]
    return float(np.sqrt(np.mean(np.maximum(squares / (_RESIDUALS - explained) - white, 0.0))))


def _pulls(
    bundle: Bundle, axes: Float[np.ndarray, "sightings 4 2 2"], gain: Float[np.ndarray, "views m unknowns"]
) -> Float[np.ndarray, "unknowns errors"]:
    """(unknowns, errors), right-hand sides for an error of 1 px of one corner of a marker along one axis in all frames.

    There are eight errors per marker. The views are eliminated.
    """
    problem, weighted = bundle.problem, axes * bundle.weight[..., None, None]
    to_shared, to_view = (
        np.einsum("scxf,scxk->sfck", part, weighted).reshape(len(axes), -1, _RESIDUALS)
        for part in bundle.slopes[1:]
    )
    error = _RESIDUALS * problem.target[:, None, None] + np.arange(_RESIDUALS)
    count, m = _RESIDUALS * len(problem.free_target), to_view.shape[1]
    column = np.where(problem.columns < 0, problem.size, problem.columns)[..., None]
    pulls = summed(to_shared, (column, error), (problem.size + 1, count))[:-1]
    of_views = summed(
        to_view, (problem.camera[:, None, None], np.arange(m)[:, None], error), (len(gain), m, count)
    )
    return pulls - np.tensordot(gain, of_views, axes=([0, 1], [0, 1]))

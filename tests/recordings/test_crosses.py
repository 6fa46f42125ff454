"""Marker crosses: learning of shapes, identification by distances, poses by least squares, bridging of gaps."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.recordings.mocap.marker_cross_poses import correct_labels, cross_poses, identify_markers
from psotrack.recordings.mocap.marker_crosses import fit_rigid, learn_cross

#: Positions of the markers A (front), B (left), C (back), D (right), metres; `FIVE_M` has a fifth marker on a mast.
FOUR_M = np.array([[0.055, 0, 0.1], [0, 0.085, 0.1], [-0.115, 0, 0.1], [0, -0.105, 0.1]])
FIVE_M = np.vstack([FOUR_M, [0.03, 0.02, 0.15]])
SQUARE_M = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]])
NOISE_M = 0.0003
RATE_HZ = 100.0


def make_flight(num_frames, seed=0, rate_hz=RATE_HZ):
    """Return rotations and positions of a drone on a realistic flight."""
    t = np.arange(num_frames) / rate_hz + seed
    position_m = np.stack([1.5 * np.sin(1.5 * t), 1.2 * np.cos(1.3 * t), 1.5 + 0.3 * np.sin(t)], axis=-1)
    turn = Rotation.from_euler(
        "ZYX", np.stack([0.7 * t, 0.15 * np.sin(1.5 * t), 0.15 * np.cos(1.3 * t)], axis=-1)
    )
    return turn, position_m


def record_markers(markers_m, num_frames=120, seed=0, noise_m=0.0, rate_hz=RATE_HZ):
    """Return the measured markers of a body in flight, (frames, markers, 3), metres."""
    turn, position_m = make_flight(num_frames, seed, rate_hz)
    markers = np.einsum("fij,mj->fmi", turn.as_matrix(), markers_m) + position_m[:, None]
    return markers + noise_m * np.random.default_rng(seed).standard_normal(markers.shape)


def centroids(markers_m, num_frames, rate_hz=RATE_HZ):
    turn, position_m = make_flight(num_frames, rate_hz=rate_hz)
    return position_m + turn.apply(markers_m.mean(axis=0))


def pairwise_distances_m(points_m):
    return np.linalg.norm(points_m[:, None] - points_m[None], axis=-1)


# --- the rigid fit


@given(seed=st.integers(0, 10_000), num_markers=st.integers(3, 6), noise_mm=st.sampled_from([0.0, 0.5, 5.0]))
def test_the_rigid_fit_agrees_with_scipy(seed, num_markers, noise_mm):
    rng = np.random.default_rng(seed)
    body_m = rng.uniform(-0.15, 0.15, (num_markers, 3))
    body_m -= body_m.mean(axis=0)
    turn, shift_m = Rotation.random(rng=rng), rng.uniform(-3, 3, 3)
    world_m = turn.apply(body_m) + shift_m + noise_mm / 1e3 * rng.standard_normal(body_m.shape)
    width_m = np.linalg.svd(body_m)[1][1] / np.sqrt(num_markers)
    found = fit_rigid(body_m, world_m[None])
    if width_m < 0.0051:  # markers on a line have no rotation; another test checks them
        return
    expected, rssd = Rotation.align_vectors(world_m - world_m.mean(axis=0), body_m)
    # Both compute the least-squares rotation in double precision; thin triangles give fewer exact digits.
    np.testing.assert_allclose(found.rotation[0], expected.as_matrix(), rtol=0, atol=1e-9)
    # SciPy's residual is the root of a difference of squares: 1e-8 instead of 0.
    np.testing.assert_allclose(found.residual_m[0], rssd / np.sqrt(num_markers), rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.position_m[0], world_m.mean(axis=0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("unseen", range(4))
def test_three_markers_give_the_pose_of_four(unseen):
    cross = learn_cross(record_markers(FOUR_M))
    markers_m = record_markers(FOUR_M)
    markers_m[50:, unseen] = np.nan
    position_m, _, bridged = cross_poses(cross, markers_m, RATE_HZ)
    assert not bridged.any()
    # Exact in double precision. The mean of three markers would have an error of at least 18 mm.
    np.testing.assert_allclose(position_m, centroids(FOUR_M, 120), rtol=0, atol=1e-9)


def test_a_quarter_turn_by_hand():
    # Each marker is at the place of the next marker: 90 degrees about z.
    quarter_m = SQUARE_M[[1, 2, 3, 0]] + [1.0, 2.0, 3.0]
    found = fit_rigid(SQUARE_M, quarter_m[None])
    np.testing.assert_allclose(found.rotation[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(found.position_m[0], [1, 2, 3], atol=1e-15)


@given(angles=st.tuples(*3 * [st.floats(-3, 3)]), seed=st.integers(0, 100))
def test_moving_the_world_moves_the_pose(angles, seed):
    cross, markers_m = learn_cross(record_markers(FIVE_M)), record_markers(FIVE_M, 3, seed, noise_m=NOISE_M)
    turn, shift_m = Rotation.from_euler("ZYX", angles), np.array([1.0, -2.0, 0.5])
    unmoved = fit_rigid(cross, markers_m)
    moved = fit_rigid(cross, np.einsum("ij,fmj->fmi", turn.as_matrix(), markers_m) + shift_m)
    np.testing.assert_allclose(moved.rotation, turn.as_matrix() @ unmoved.rotation, rtol=0, atol=1e-10)
    np.testing.assert_allclose(moved.position_m, turn.apply(unmoved.position_m) + shift_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(moved.residual_m, unmoved.residual_m, rtol=0, atol=1e-12)


@pytest.mark.parametrize("num_markers", [1, 2, 3])
def test_markers_on_a_line_have_a_position_but_no_rotation(num_markers):
    line_m = np.array([[0.1, 0.1, 0.1]]) * np.arange(num_markers)[:, None]
    markers_m = record_markers(line_m, 20)
    markers_m[10:15, 0] = np.nan
    position_m, orientation_wxyz, bridged = cross_poses(learn_cross(markers_m), markers_m, RATE_HZ)
    assert np.isnan(orientation_wxyz).all()
    assert np.isfinite(position_m).all()
    assert bridged.tolist() == [False] * 10 + [True] * 5 + [False] * 5
    np.testing.assert_allclose(position_m[:10], markers_m[:10].mean(axis=1), rtol=0, atol=1e-12)


def test_no_frames_and_no_markers_seen():
    cross = learn_cross(record_markers(FOUR_M))
    assert cross_poses(cross, np.zeros((0, 4, 3)), RATE_HZ)[0].shape == (0, 3)
    position_m, orientation_wxyz, bridged = cross_poses(cross, np.full((5, 4, 3), np.nan), RATE_HZ)
    assert np.isnan(position_m).all()
    assert np.isnan(orientation_wxyz).all()
    assert not bridged.any()


# --- learning the shape


@pytest.mark.parametrize("markers_m", [FOUR_M, FIVE_M], ids=["four", "five"])
def test_a_cross_is_learned(markers_m):
    cross = learn_cross(record_markers(markers_m, 400, noise_m=NOISE_M))
    # The tolerance is five standard errors of a distance between means, 0.3 mm sqrt(2 / 400).
    np.testing.assert_allclose(
        pairwise_distances_m(cross), pairwise_distances_m(markers_m), rtol=0, atol=1.1e-4
    )


@pytest.mark.parametrize("markers_m", [FOUR_M, FIVE_M], ids=["four", "five"])
def test_the_frame_depends_on_the_shape_only(markers_m):
    """Two recordings of different flights give the same frame."""
    first, second = (learn_cross(record_markers(markers_m, seed=seed)) for seed in (1, 2))
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-9)


def test_x_points_to_the_first_marker_and_z_up():
    for shape_m in (FOUR_M, FIVE_M, FOUR_M[:3]):
        cross = learn_cross(record_markers(shape_m))
        assert cross[0, 0] > 0
        assert cross[0, 1] == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(
            pairwise_distances_m(cross), pairwise_distances_m(shape_m), rtol=0, atol=1e-9
        )
    # The markers of the first shape are in a plane that is level in the drone's own frame.
    np.testing.assert_allclose(learn_cross(record_markers(FOUR_M))[:, 2], 0, atol=1e-9)


def test_a_cross_is_learned_despite_swapped_labels_and_unseen_markers():
    """A quarter of the frames has two swapped labels, a tenth has a stray marker; no frame sees all markers."""
    markers_m = record_markers(FIVE_M, 400, noise_m=NOISE_M)
    markers_m[:100, [0, 1]] = markers_m[:100, [1, 0]]
    markers_m[100:140, 2] += 0.5
    markers_m[np.arange(400), np.arange(400) % 5] = np.nan
    cross = learn_cross(markers_m)
    # Each marker has 208 correct positions with noise of 0.3 mm.
    np.testing.assert_allclose(pairwise_distances_m(cross), pairwise_distances_m(FIVE_M), rtol=0, atol=1.5e-4)


def test_markers_that_are_never_seen_together_are_an_error():
    markers_m = record_markers(FOUR_M)
    markers_m[:60, 1] = np.nan
    markers_m[60:, 3] = np.nan
    with pytest.raises(InputError, match=r"cross dron4: expected every two markers seen together .* 2 and 4"):
        learn_cross(markers_m, "dron4")


def test_every_cross_has_its_origin_at_its_centroid():
    np.testing.assert_allclose(learn_cross(record_markers(FIVE_M)).mean(axis=0), 0, atol=1e-12)


# --- identification of markers


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
def test_every_permutation_is_found(order):
    cross = learn_cross(record_markers(FOUR_M))
    points_m = record_markers(FOUR_M, 1, seed=3, noise_m=NOISE_M)[0]
    np.testing.assert_array_equal(identify_markers(cross, points_m[list(order)]), points_m)
    without_m = points_m.copy()
    without_m[order[3]] = np.nan
    np.testing.assert_array_equal(identify_markers(cross, points_m[list(order[:3])]), without_m)


def test_markers_among_stray_points():
    cross = learn_cross(record_markers(FIVE_M))
    points_m = record_markers(FIVE_M, 1, seed=3, noise_m=NOISE_M)[0]
    strays_m = points_m[0] + np.random.default_rng(0).uniform(-1, 1, (20, 3))
    mixed_m = np.vstack([strays_m[:7], points_m[[3, 0]], strays_m[7:], points_m[[4, 1, 2]]])
    np.testing.assert_array_equal(identify_markers(cross, mixed_m), points_m)


def test_a_mirror_image_is_not_identified():
    """All distances of a mirror image fit, but no rotation does."""
    body_m = np.array([[0.1, 0, 0], [0, 0.13, 0], [-0.07, 0, 0], [0.01, 0.02, 0.12]])
    cross = learn_cross(record_markers(body_m))
    np.testing.assert_array_equal(identify_markers(cross, body_m), body_m)
    assert np.isnan(identify_markers(cross, body_m * [1, 1, -1])).any()


@pytest.mark.parametrize(
    "points_m",
    [np.zeros((0, 3)), FOUR_M[:2], FOUR_M * 1.5, SQUARE_M * 3],
    ids=["none", "two", "larger", "another"],
)
def test_points_that_are_not_the_cross(points_m):
    assert np.isnan(identify_markers(learn_cross(record_markers(FOUR_M)), points_m)).all()


def test_the_markers_of_a_symmetric_cross_are_not_identified():
    assert np.isnan(identify_markers(SQUARE_M, SQUARE_M + 1.0)).all()


def test_a_body_of_many_markers_is_identified_at_once():
    """All subsets of the right labelling fit too: a million of 20 markers."""
    body_m = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
    cross = body_m - body_m.mean(axis=0)
    order = np.random.default_rng(1).permutation(20)
    np.testing.assert_array_equal(identify_markers(cross, body_m[order]), body_m)


# --- poses over time


def test_swapped_labels_change_no_pose():
    cross = learn_cross(record_markers(FOUR_M))
    markers_m = record_markers(FOUR_M, noise_m=NOISE_M)
    expected_m, expected_wxyz, _ = cross_poses(cross, markers_m, RATE_HZ)
    swapped_m = markers_m.copy()
    swapped_m[30:40, [0, 1]] = markers_m[30:40, [1, 0]]
    swapped_m[60, [0, 1, 2, 3]] = markers_m[60, [3, 0, 1, 2]]
    swapped_m[70, [0, 1]], swapped_m[70, 3] = markers_m[70, [1, 0]], np.nan
    position_m, orientation_wxyz, bridged = cross_poses(cross, swapped_m, RATE_HZ)
    others = np.arange(120) != 70  # in frame 70, the fourth marker is missing too
    assert not bridged.any()
    np.testing.assert_array_equal(position_m[others], expected_m[others])
    np.testing.assert_array_equal(orientation_wxyz[others], expected_wxyz[others])
    # Without one marker with noise of 0.3 mm the centroid moves by less than a millimetre.
    np.testing.assert_allclose(position_m[70], expected_m[70], rtol=0, atol=1e-3)


def test_a_marker_that_jumps_to_another_body_is_left_out():
    markers_m = record_markers(FIVE_M)
    cross = learn_cross(markers_m)
    markers_m[20:30, 2] = [3.0, 3.0, 1.0]
    position_m, _, bridged = cross_poses(cross, markers_m, RATE_HZ)
    assert not bridged.any()
    np.testing.assert_allclose(position_m, centroids(FIVE_M, 120), rtol=0, atol=1e-9)


def test_frames_in_which_nothing_fits_are_gaps():
    markers_m = record_markers(FOUR_M)
    cross = learn_cross(markers_m)
    markers_m[20:25] = np.random.default_rng(0).uniform(-1, 1, (5, 4, 3))
    assert np.isnan(correct_labels(cross, markers_m)[20:25]).all()
    assert np.flatnonzero(cross_poses(cross, markers_m, RATE_HZ)[2]).tolist() == [20, 21, 22, 23, 24]


@pytest.mark.parametrize(("gap", "short"), [(1, True), (20, True), (50, True), (51, False)])
def test_gaps_are_bridged_to_half_a_second(gap, short):
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 300)
    markers_m[100 : 100 + gap, :2] = np.nan  # two markers are left, which is no pose
    position_m, orientation_wxyz, bridged = cross_poses(cross, markers_m, RATE_HZ)
    inside = np.zeros(300, bool)
    inside[100 : 100 + gap] = True
    assert bridged.tolist() == (inside & short).tolist()
    assert np.isnan(position_m[:, 0]).tolist() == (inside & (not short)).tolist()
    assert np.isnan(orientation_wxyz[:, 0]).tolist() == (inside & (not short)).tolist()
    if short:
        turn, _ = make_flight(300)
        off_m = np.linalg.norm(position_m - centroids(FOUR_M, 300), axis=1)
        # The error of a cubic over the time T is T^4 / 384 times the fourth derivative, 1.5 m (1.5 / s)^4: 1.2 mm in
        # half a second. The error of its slopes, a tenth of the jerk of 5 m/s^3 times (0.1 s)^2, adds T / 8 times that:
        # 0.5 mm. The error of a straight line would be 104 mm.
        assert off_m.max() < 0.003
        body = Rotation.from_quat(orientation_wxyz, scalar_first=True)
        off_deg = np.degrees((turn[0].inv() * body[0] * body.inv() * turn).magnitude())
        assert off_deg.max() < 1.0  # T^2 / 8 times the tilt acceleration of 0.34 rad/s^2, about two axes


def test_gaps_at_the_ends_are_not_bridged():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 100)
    markers_m[:5] = markers_m[95:] = np.nan
    position_m, _, bridged = cross_poses(cross, markers_m, RATE_HZ)
    assert not bridged.any()
    assert np.flatnonzero(np.isnan(position_m[:, 0])).tolist() == [*range(5), *range(95, 100)]


def test_a_single_pose_between_gaps():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 3, rate_hz=20.0)
    markers_m[1] = np.nan
    position_m, _, _ = cross_poses(cross, markers_m, 20.0)
    np.testing.assert_allclose(position_m[1], position_m[[0, 2]].mean(axis=0), rtol=0, atol=1e-12)

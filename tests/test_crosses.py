"""Marker crosses: learning of shapes, identification by distances, poses by least squares, bridging of gaps."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError
from psotrack.recordings.mocap.marker_cross_poses import (
    complete_markers,
    correct_labels,
    estimate_poses,
    interpolate_poses,
)
from psotrack.recordings.mocap.marker_crosses import (
    Cross,
    fit_rigid,
    identify_markers,
    learn_cross,
)

#: Positions of the markers A (front), B (left), C (back), D (right), metres; `FIVE_M` has a fifth marker on a mast.
FOUR_M = np.array([[0.055, 0, 0.1], [0, 0.085, 0.1], [-0.115, 0, 0.1], [0, -0.105, 0.1]])
FIVE_M = np.vstack([FOUR_M, [0.03, 0.02, 0.15]])
OTHERS_M = (
    np.array([[0.115, 0, 0], [0, 0.120, 0], [-0.095, 0, 0], [0, -0.060, 0]]),
    np.array([[0.085, 0, 0], [0, 0.140, 0], [-0.040, 0, 0], [0, -0.050, 0]]),
)
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
    found = estimate_poses(cross, markers_m, RATE_HZ)
    assert not found.bridged.any()
    # Exact in double precision. The mean of three markers would have an error of at least 18 mm.
    np.testing.assert_allclose(found.position_m, centroids(FOUR_M, 120), rtol=0, atol=1e-9)


def test_a_quarter_turn_by_hand():
    square = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]])
    quarter_m = square[[1, 2, 3, 0]] + [
        1.0,
        2.0,
        3.0,
    ]  # each marker is at the place of the next marker: 90 degrees about z
    found = fit_rigid(square, quarter_m[None])
    np.testing.assert_allclose(found.rotation[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(found.position_m[0], [1, 2, 3], atol=1e-15)


@given(angles=st.tuples(*3 * [st.floats(-3, 3)]), seed=st.integers(0, 100))
def test_moving_the_world_moves_the_pose(angles, seed):
    cross, markers_m = learn_cross(record_markers(FIVE_M)), record_markers(FIVE_M, 3, seed, noise_m=NOISE_M)
    turn, shift_m = Rotation.from_euler("ZYX", angles), np.array([1.0, -2.0, 0.5])
    unmoved = fit_rigid(cross.markers_m, markers_m)
    moved = fit_rigid(cross.markers_m, np.einsum("ij,fmj->fmi", turn.as_matrix(), markers_m) + shift_m)
    np.testing.assert_allclose(moved.rotation, turn.as_matrix() @ unmoved.rotation, rtol=0, atol=1e-10)
    np.testing.assert_allclose(moved.position_m, turn.apply(unmoved.position_m) + shift_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(moved.residual_m, unmoved.residual_m, rtol=0, atol=1e-12)


@pytest.mark.parametrize("num_markers", [1, 2, 3])
def test_markers_on_a_line_have_a_position_but_no_rotation(num_markers):
    line_m = np.array([[0.1, 0.1, 0.1]]) * np.arange(num_markers)[:, None]
    markers_m = record_markers(line_m, 20)
    markers_m[10:15, 0] = np.nan
    found = estimate_poses(learn_cross(markers_m), markers_m, RATE_HZ, max_gap_s=0.01)
    assert np.isnan(found.orientation_wxyz).all()
    assert np.isnan(found.position_m[:, 0]).tolist() == [False] * 10 + [True] * 5 + [False] * 5
    np.testing.assert_allclose(found.position_m[:10], markers_m[:10].mean(axis=1), rtol=0, atol=1e-12)


def test_no_frames_and_no_markers_seen():
    cross = learn_cross(record_markers(FOUR_M))
    assert estimate_poses(cross, np.zeros((0, 4, 3)), RATE_HZ).position_m.shape == (0, 3)
    unseen = estimate_poses(cross, np.full((5, 4, 3), np.nan), RATE_HZ)
    assert np.isnan(unseen.position_m).all()
    assert np.isnan(unseen.orientation_wxyz).all()


# --- learning the shape


@pytest.mark.parametrize("markers_m", [FOUR_M, FIVE_M], ids=["four", "five"])
def test_a_cross_is_learned(markers_m):
    cross = learn_cross(record_markers(markers_m, 400, noise_m=NOISE_M), "dron4")
    assert cross.name == "dron4"
    # The tolerance is five standard errors of a distance between means, 0.3 mm sqrt(2 / 400).
    np.testing.assert_allclose(
        pairwise_distances_m(cross.markers_m), pairwise_distances_m(markers_m), rtol=0, atol=1.1e-4
    )


@pytest.mark.parametrize("markers_m", [FOUR_M, FIVE_M], ids=["four", "five"])
def test_the_frame_depends_on_the_shape_only(markers_m):
    """Two recordings of different flights give the same frame."""
    first, second = (learn_cross(record_markers(markers_m, seed=seed)) for seed in (1, 2))
    np.testing.assert_allclose(first.markers_m, second.markers_m, rtol=0, atol=1e-9)


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [0, 3, 1, 2], [0, 2, 3, 1]])
def test_x_is_along_the_first_beam_of_a_cross_and_z_is_up(order):
    """The arms of `FOUR_M` are parallel to its axes, and its first marker is at the front."""
    cross = learn_cross(record_markers(FOUR_M[order]))
    np.testing.assert_allclose(cross.markers_m, (FOUR_M - FOUR_M.mean(axis=0))[order], rtol=0, atol=1e-9)


def test_x_points_to_the_first_marker_without_crossing_beams():
    """A marker within a triangle has no opposite marker, and three markers have no opposite markers either."""
    for shape_m in (
        np.array([[0.12, 0, 0], [-0.05, 0.1, 0], [-0.07, -0.06, 0], [0.01, 0.01, 0]]),
        FOUR_M[:3],
    ):
        cross = learn_cross(record_markers(shape_m))
        np.testing.assert_allclose(cross.markers_m[0, 1:], 0, atol=1e-9)
        assert cross.markers_m[0, 0] == pytest.approx(
            np.linalg.norm(shape_m[0] - shape_m.mean(axis=0)), abs=1e-9
        )
        np.testing.assert_allclose(
            pairwise_distances_m(cross.markers_m), pairwise_distances_m(shape_m), rtol=0, atol=1e-9
        )


def test_a_cross_is_learned_despite_swapped_labels_and_unseen_markers():
    """A quarter of the frames has two swapped labels, a tenth has a stray marker; no frame sees all markers."""
    markers_m = record_markers(FIVE_M, 400, noise_m=NOISE_M)
    markers_m[:100, [0, 1]] = markers_m[:100, [1, 0]]
    markers_m[100:140, 2] += 0.5
    markers_m[np.arange(400), np.arange(400) % 5] = np.nan
    cross = learn_cross(markers_m)
    # Each marker has 208 correct positions with noise of 0.3 mm.
    np.testing.assert_allclose(
        pairwise_distances_m(cross.markers_m), pairwise_distances_m(FIVE_M), rtol=0, atol=1.5e-4
    )


def test_markers_that_are_never_seen_together_are_an_error():
    markers_m = record_markers(FOUR_M)
    markers_m[:60, 1] = np.nan
    markers_m[60:, 3] = np.nan
    with pytest.raises(InputError, match=r"cross dron4: expected every two markers seen together .* 2 and 4"):
        learn_cross(markers_m, "dron4")


def test_a_cross_has_its_origin_at_its_centroid():
    with pytest.raises(
        SettingsError, match="cross dron4: expected markers with their centroid at the origin"
    ):
        Cross("dron4", FOUR_M)


# --- identification of markers and crosses


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
def test_every_permutation_is_found(order):
    cross = learn_cross(record_markers(FOUR_M))
    points_m = record_markers(FOUR_M, 1, seed=3, noise_m=NOISE_M)[0]
    assert identify_markers(cross, points_m[list(order)]).tolist() == list(order)
    assert identify_markers(cross, points_m[list(order[:3])]).tolist() == list(order[:3])


def test_markers_among_stray_points():
    cross = learn_cross(record_markers(FIVE_M))
    points_m = record_markers(FIVE_M, 1, seed=3, noise_m=NOISE_M)[0]
    strays_m = points_m[0] + np.random.default_rng(0).uniform(-1, 1, (20, 3))
    mixed_m = np.vstack([strays_m[:7], points_m[[3, 0]], strays_m[7:], points_m[[4, 1, 2]]])
    assert identify_markers(cross, mixed_m).tolist() == [-1] * 7 + [3, 0] + [-1] * 13 + [4, 1, 2]


def test_a_mirror_image_is_not_identified():
    """All distances of a mirror image fit, but no rotation does."""
    body_m = np.array([[0.1, 0, 0], [0, 0.13, 0], [-0.07, 0, 0], [0.01, 0.02, 0.12]])
    cross = learn_cross(record_markers(body_m))
    assert identify_markers(cross, body_m).tolist() == [0, 1, 2, 3]
    assert identify_markers(cross, body_m * [1, 1, -1]).max() == -1 or -1 in identify_markers(
        cross, body_m * [1, 1, -1]
    )


@pytest.mark.parametrize(
    "points_m",
    [
        np.zeros((0, 3)),
        FOUR_M[:2],
        FOUR_M * 1.5,
        np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]]) * 3,
    ],
    ids=["none", "two", "larger", "another"],
)
def test_points_that_are_not_the_cross(points_m):
    cross = learn_cross(record_markers(FOUR_M))
    assert identify_markers(cross, points_m).tolist() == [-1] * len(points_m)


def test_the_markers_of_a_symmetric_cross_are_not_identified():
    square = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]])
    cross = Cross("square", square)
    assert identify_markers(cross, square + 1.0).tolist() == [-1] * 4


# --- poses over time


def test_swapped_labels_change_no_pose():
    cross = learn_cross(record_markers(FOUR_M))
    markers_m = record_markers(FOUR_M, noise_m=NOISE_M)
    expected = estimate_poses(cross, markers_m, RATE_HZ)
    swapped_m = markers_m.copy()
    swapped_m[30:40, [0, 1]] = markers_m[30:40, [1, 0]]
    swapped_m[60, [0, 1, 2, 3]] = markers_m[60, [3, 0, 1, 2]]
    swapped_m[70, [0, 1]], swapped_m[70, 3] = markers_m[70, [1, 0]], np.nan
    found = estimate_poses(cross, swapped_m, RATE_HZ)
    others = np.arange(120) != 70  # in frame 70, the fourth marker is missing too
    assert not found.bridged.any()
    np.testing.assert_array_equal(found.position_m[others], expected.position_m[others])
    np.testing.assert_array_equal(found.orientation_wxyz[others], expected.orientation_wxyz[others])
    # Without one marker with noise of 0.3 mm the centroid moves by less than a millimetre.
    np.testing.assert_allclose(found.position_m[70], expected.position_m[70], rtol=0, atol=1e-3)


def test_a_marker_that_jumps_to_another_body_is_left_out():
    cross = learn_cross(record_markers(FIVE_M))
    markers_m = record_markers(FIVE_M)
    markers_m[20:30, 2] = [3.0, 3.0, 1.0]
    found = estimate_poses(cross, markers_m, RATE_HZ)
    np.testing.assert_allclose(found.position_m, centroids(FIVE_M, 120), rtol=0, atol=1e-9)


def test_frames_in_which_nothing_fits_are_gaps():
    cross = learn_cross(record_markers(FOUR_M))
    markers_m = record_markers(FOUR_M)
    markers_m[20:25] = np.random.default_rng(0).uniform(-1, 1, (5, 4, 3))
    assert np.isnan(correct_labels(cross, markers_m)[20:25]).all()
    assert np.flatnonzero(estimate_poses(cross, markers_m, RATE_HZ).bridged).tolist() == [20, 21, 22, 23, 24]


@pytest.mark.parametrize(("gap", "bridged"), [(1, True), (20, True), (50, True), (51, False)])
def test_gaps_are_bridged_to_half_a_second(gap, bridged):
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 300)
    markers_m[100 : 100 + gap, :2] = np.nan  # two markers are left, which is no pose
    found = estimate_poses(cross, markers_m, RATE_HZ)
    inside = np.zeros(300, bool)
    inside[100 : 100 + gap] = True
    assert found.bridged.tolist() == (inside & bridged).tolist()
    assert np.isnan(found.position_m[:, 0]).tolist() == (inside & (not bridged)).tolist()
    assert np.isnan(found.orientation_wxyz[:, 0]).tolist() == (inside & (not bridged)).tolist()
    if bridged:
        turn, _ = make_flight(300)
        off_m = np.linalg.norm(found.position_m - centroids(FOUR_M, 300), axis=1)
        # The error of a cubic over the time T is T^4 / 384 times the fourth derivative, 1.5 m (1.5 / s)^4: 1.2 mm in
        # half a second. The error of its slopes, a tenth of the jerk of 5 m/s^3 times (0.1 s)^2, adds T / 8 times that:
        # 0.5 mm. The error of a straight line would be 104 mm.
        assert off_m.max() < 0.003
        body = Rotation.from_quat(found.orientation_wxyz, scalar_first=True)
        off_deg = np.degrees((turn[0].inv() * body[0] * body.inv() * turn).magnitude())
        assert off_deg.max() < 1.0  # T^2 / 8 times the tilt acceleration of 0.34 rad/s^2, about two axes


def test_gaps_at_the_ends_are_not_bridged():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 100)
    markers_m[:5] = markers_m[95:] = np.nan
    found = estimate_poses(cross, markers_m, RATE_HZ)
    assert not found.bridged.any()
    assert np.flatnonzero(np.isnan(found.position_m[:, 0])).tolist() == [*range(5), *range(95, 100)]


def test_a_single_pose_between_gaps():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 3, rate_hz=20.0)
    markers_m[1] = np.nan
    found = estimate_poses(cross, markers_m, 20.0, max_gap_s=0.06)
    np.testing.assert_allclose(found.position_m[1], found.position_m[[0, 2]].mean(axis=0), rtol=0, atol=1e-12)


@given(rate_hz=st.floats(80, 400), fps=st.floats(10, 60), offset_s=st.floats(0, 0.5))
def test_poses_are_interpolated_at_any_time_between_frames(rate_hz, fps, offset_s):
    cross = learn_cross(record_markers(FOUR_M))
    num_frames = int(2 * rate_hz)
    time_s = np.arange(int(1.4 * fps)) / fps + offset_s
    found = interpolate_poses(
        estimate_poses(cross, record_markers(FOUR_M, num_frames, rate_hz=rate_hz), rate_hz), rate_hz, time_s
    )
    turn, position_m = make_flight(len(time_s), seed=offset_s, rate_hz=fps)
    # The interpolation error is dt^2 / 8 times 4 m/s^2, at 80 Hz 0.08 mm.
    np.testing.assert_allclose(
        found.position_m, position_m + turn.apply(FOUR_M.mean(axis=0)), rtol=0, atol=1e-4
    )
    body = Rotation.from_quat(found.orientation_wxyz, scalar_first=True)
    fixed = turn.inv() * body  # the rotation from the cross's frame to the drone's frame is constant
    assert (
        np.degrees((fixed * fixed[0].inv()).magnitude()).max() < 0.01
    )  # dt^2 / 8 times 0.5 rad/s^2: 6e-4 degrees


def test_interpolation_at_frame_times_returns_the_poses_of_the_frames():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M)
    markers_m[60:] = np.nan
    frame_poses = estimate_poses(cross, markers_m, RATE_HZ)
    found = interpolate_poses(frame_poses, RATE_HZ, np.arange(40) / 25)
    # Frame 14 of the video is frame 56, the last seen frame: a later time would need the unseen next frame.
    np.testing.assert_array_equal(found.position_m[:15], frame_poses.position_m[:60:4])
    assert np.isnan(found.position_m[15:]).all()
    outside = interpolate_poses(frame_poses, RATE_HZ, np.array([-0.01, 1.2, 0.595]))
    assert np.isnan(outside.position_m).all()
    assert not outside.bridged.any()


def test_bridged_gaps_are_flagged_at_interpolated_times():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M)
    markers_m[41:44] = np.nan
    found = interpolate_poses(
        estimate_poses(cross, markers_m, RATE_HZ), RATE_HZ, np.array([0.395, 0.405, 0.42, 0.435, 0.445])
    )
    assert found.bridged.tolist() == [False, True, True, True, False]
    assert np.isfinite(found.position_m).all()


def test_lost_labels_are_recovered():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, noise_m=NOISE_M)
    labelled_m, unlabelled_m = markers_m.copy(), np.full((120, 6, 3), np.nan)
    unlabelled_m[:, 0] = [2.0, 2.0, 0.0]  # a reflection on the floor
    labelled_m[10, [1, 2]], unlabelled_m[10, [4, 1]] = np.nan, markers_m[10, [1, 2]]
    labelled_m[11], unlabelled_m[11, 1:5] = np.nan, markers_m[11, [3, 1, 0, 2]]
    labelled_m[12], unlabelled_m[12, 1:4] = np.nan, markers_m[12, [3, 1, 0]]
    completed_m = complete_markers(cross, labelled_m, unlabelled_m)
    rest = np.arange(120) != 12  # three unlabelled points are too few
    np.testing.assert_array_equal(completed_m[rest], markers_m[rest])
    assert np.isnan(completed_m[12]).all()

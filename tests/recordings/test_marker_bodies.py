"""Bodies in motion capture: which markers are a drone's, the shape of its cross, its poses, and gaps in them."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_refused
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.recordings.mocap import Markers, marker_bodies
from psotrack.recordings.mocap.marker_cross_poses import correct_labels, cross_poses, identify_markers
from psotrack.recordings.mocap.marker_crosses import fit_rigid, learn_cross
from psotrack.trajectories import Status, Trajectories, resample

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
    # Markers on a line have no rotation; another test checks them.
    assume(np.linalg.svd(body_m)[1][1] / np.sqrt(num_markers) > 0.0051)
    turn, shift_m = Rotation.random(rng=rng), rng.uniform(-3, 3, 3)
    world_m = turn.apply(body_m) + shift_m + noise_mm / 1e3 * rng.standard_normal(body_m.shape)
    found = fit_rigid(body_m, world_m[None])
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


@pytest.mark.parametrize("markers_m", [FOUR_M, FIVE_M, FOUR_M[:3]], ids=["four", "five", "three"])
def test_the_frame_of_a_learned_cross_depends_on_its_shape_only(markers_m):
    """Two recordings of different flights give the same frame: x points to the first marker, and z up."""
    first, second = (learn_cross(record_markers(markers_m, seed=seed)) for seed in (1, 2))
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-9)
    np.testing.assert_allclose(first.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(pairwise_distances_m(first), pairwise_distances_m(markers_m), atol=1e-9)
    assert first[0, 0] > 0
    assert first[0, 1] == pytest.approx(0, abs=1e-9)
    # The markers of `FOUR_M` are in a plane that is level in the drone's own frame; the mast of `FIVE_M` stands up.
    if len(markers_m) == 5:
        assert first[4, 2] > first[:4, 2].max()
    else:
        np.testing.assert_allclose(first[:, 2], 0, atol=1e-9)


def test_a_cross_is_learned_despite_swapped_labels_and_unseen_markers():
    """A quarter of the frames has two swapped labels, a tenth has a stray marker; no frame sees all markers."""
    markers_m = record_markers(FIVE_M, 400, noise_m=NOISE_M)
    markers_m[:100, [0, 1]] = markers_m[:100, [1, 0]]
    markers_m[100:140, 2] += 0.5
    markers_m[np.arange(400), np.arange(400) % 5] = np.nan
    cross = learn_cross(markers_m)
    # Each marker has 208 correct positions with noise of 0.3 mm.
    np.testing.assert_allclose(pairwise_distances_m(cross), pairwise_distances_m(FIVE_M), rtol=0, atol=1.5e-4)


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
    # A symmetric cross fits itself in more than one way.
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
    # In frame 70, the fourth marker is missing too.
    others = np.arange(120) != 70
    assert not bridged.any()
    np.testing.assert_array_equal(position_m[others], expected_m[others])
    np.testing.assert_array_equal(orientation_wxyz[others], expected_wxyz[others])
    # Without one marker with noise of 0.3 mm the centroid moves by less than a millimetre.
    np.testing.assert_allclose(position_m[70], expected_m[70], rtol=0, atol=1e-3)


def test_stray_markers_are_left_out_and_frames_in_which_nothing_fits_are_gaps():
    markers_m = record_markers(FIVE_M)
    cross = learn_cross(markers_m)
    # A marker jumps to another body, and later all markers are anywhere.
    markers_m[20:30, 2] = [3.0, 3.0, 1.0]
    markers_m[50:55] = np.random.default_rng(0).uniform(-1, 1, (5, 5, 3))
    position_m, _, bridged = cross_poses(cross, markers_m, RATE_HZ)
    assert np.isnan(correct_labels(cross, markers_m)[50:55]).all()
    assert np.flatnonzero(bridged).tolist() == [50, 51, 52, 53, 54]
    np.testing.assert_allclose(position_m[~bridged], centroids(FIVE_M, 120)[~bridged], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("gap", "short"), [(1, True), (20, True), (50, True), (51, False)])
def test_gaps_are_bridged_to_half_a_second(gap, short):
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 300)
    # Two markers are left, which is no pose. Gaps at the ends are not bridged.
    markers_m[100 : 100 + gap, :2] = np.nan
    markers_m[:5] = markers_m[295:] = np.nan
    position_m, orientation_wxyz, bridged = cross_poses(cross, markers_m, RATE_HZ)
    inside, ends = np.zeros(300, bool), np.ones(300, bool)
    inside[100 : 100 + gap], ends[5:295] = True, False
    assert bridged.tolist() == (inside & short).tolist()
    assert np.isnan(position_m[:, 0]).tolist() == (ends | (inside & (not short))).tolist()
    assert np.isnan(orientation_wxyz[:, 0]).tolist() == (ends | (inside & (not short))).tolist()
    if short:
        turn, _ = make_flight(300)
        off_m = np.linalg.norm(position_m - centroids(FOUR_M, 300), axis=1)
        # The error of a cubic over the time T is T^4 / 384 times the fourth derivative, 1.5 m (1.5 / s)^4: 1.2 mm in
        # half a second. The error of its slopes, a tenth of the jerk of 5 m/s^3 times (0.1 s)^2, adds T / 8 times that:
        # 0.5 mm. The error of a straight line would be 104 mm.
        assert off_m[~ends].max() < 0.003
        body = Rotation.from_quat(orientation_wxyz[~ends], scalar_first=True)
        turn = turn[~ends]
        off_deg = np.degrees((turn[0].inv() * body[0] * body.inv() * turn).magnitude())
        # T^2 / 8 times the tilt acceleration of 0.34 rad/s^2, about two axes.
        assert off_deg.max() < 1.0


def test_a_single_pose_between_gaps():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 3, rate_hz=20.0)
    markers_m[1] = np.nan
    position_m, _, _ = cross_poses(cross, markers_m, 20.0)
    np.testing.assert_allclose(position_m[1], position_m[[0, 2]].mean(axis=0), rtol=0, atol=1e-12)


# --- bodies of a recording

WHERE = Path("R01_D2.c3d")
#: Positions of the markers of the bodies of `make_markers`, which fly without turning, metres.
CROSS_M = np.array([[0.2, 0, 0.05], [-0.15, 0, 0.05], [0, 0.18, 0.05], [0, -0.12, 0.05], [0.05, 0.05, 0.09]])


def paths_m(time_s, count):
    """(times, bodies, 3), curved paths of the middles of bodies."""
    t = np.asarray(time_s)[:, None]
    return np.stack(
        [np.hstack([i + np.sin(t + i), np.cos(2 * t), 1 + 0.3 * t]) for i in range(count)], axis=1
    )


def make_markers(num_frames=41, drones=("Dron2", "Dron10"), rate_hz=RATE_HZ) -> tuple[Markers, np.ndarray]:
    """Markers of drones, and the centroids of each drone's markers, (frames, drones, 3)."""
    middles_m = paths_m(np.arange(num_frames) / rate_hz, len(drones))
    position_m = (middles_m[:, :, None] + CROSS_M).reshape(num_frames, -1, 3)
    labels = tuple(f"{drone}:{drone}{i + 1}" for drone in drones for i in range(len(CROSS_M)))
    return Markers(labels, position_m, rate_hz), middles_m + CROSS_M.mean(axis=0)


def with_markers(markers, labels, position_m) -> Markers:
    """The recording with more markers: positions (frames, more, 3), or one position of all frames."""
    more_m = np.broadcast_to(position_m, (len(markers.position_m), len(labels), 3))
    whole_m = np.concatenate([markers.position_m, more_m], axis=1)
    return Markers((*markers.labels, *labels), whole_m, markers.rate_hz)


def at_frames(markers, fps=25.0, num_frames=9, offset_s=0.0) -> Trajectories:
    """The drones of a recording at the frames of a video."""
    frame = np.arange(num_frames)
    return resample(marker_bodies(markers, WHERE), frame, frame / fps, later_s=offset_s)


def test_the_drones_of_a_recording():
    """A video frame takes every fourth frame of motion capture; a marker that was never seen does not count."""
    markers, centroid_m = make_markers(num_frames=17)
    markers.position_m[5:12, 6] = np.nan
    markers.position_m[8, [0, 1]] = markers.position_m[8, [1, 0]]
    markers.position_m[12:16, [5, 6, 7]] = markers.position_m[12:16, [7, 5, 6]]
    truth = at_frames(with_markers(markers, ["Dron2:Dron26", "*12", "Wand:Wand1"], [np.nan, 9, 9]))
    # Sorted by number; as text, `dron10` would come first.
    assert truth.drones == ("dron2", "dron10")
    assert truth.seen.tolist() == [[True, True]] * 5 + [[False, False]] * 4
    # The tolerance covers the rounding of fits in double precision. The centroid of the visible markers would have an
    # error of centimetres.
    np.testing.assert_allclose(truth.position_m[:5], centroid_m[::4], rtol=0, atol=1e-9)
    np.testing.assert_allclose(truth.time_s, np.arange(9) / 25)
    turn = Rotation.from_quat(truth.orientation_wxyz[:5].reshape(-1, 4), scalar_first=True)
    # An angle of 1e-8 has the cosine 1 in double precision.
    assert (turn[0].inv() * turn).magnitude().max() < 1e-7


def test_short_gaps_are_flagged_and_long_gaps_remain():
    """dron2 has a gap of 0.3 s; dron10 has a gap of 0.6 s, because two of its five markers determine no pose."""
    markers, centroid_m = make_markers(num_frames=141)
    markers.position_m[40:70, :5] = np.nan
    markers.position_m[40:100, 5:8] = np.nan
    status = marker_bodies(markers, WHERE).status
    assert np.flatnonzero(status[:, 0] == Status.COASTING).tolist() == [*range(40, 70)]
    assert np.flatnonzero(status[:, 1] == Status.LOST).tolist() == [*range(40, 100)]
    assert (status == Status.TRACKED).sum() == 2 * 141 - 30 - 60
    truth = at_frames(markers, num_frames=36)
    assert truth.seen[:, 0].all()
    assert np.flatnonzero(~truth.seen[:, 1]).tolist() == [*range(10, 25)]
    assert np.isnan(truth.orientation_wxyz[10:25, 1]).all()
    # The error of a cubic is T^4 / 384 times 16 m/s^4 plus T / 8 times the error of its slopes, 0.01 s^2 / 10 times
    # 8 m/s^3: 0.6 mm in total.
    np.testing.assert_allclose(truth.position_m[:, 0], centroid_m[::4, 0], rtol=0, atol=1e-3)


def test_a_drone_whose_markers_are_never_seen_together_is_lost(caplog):
    markers, centroid_m = make_markers()
    markers.position_m[:20, 1] = np.nan
    markers.position_m[20:, 3] = np.nan
    truth = at_frames(markers)
    words = "R01_D2.c3d: no reference for dron2: cross dron2: expected every two markers seen together in some frame"
    assert f"{words}, found 2 and 4 never" in caplog.text
    assert np.isnan(truth.position_m[:, 0]).all()
    np.testing.assert_allclose(truth.position_m[:, 1], centroid_m[0:36:4, 1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("fps", [25.0, 29.97])
@pytest.mark.parametrize("rate_hz", [100.0, 25.0, 119.88, 59.94])
@pytest.mark.parametrize("offset_s", [0.0, 0.2, -0.08, -0.1])
def test_any_rates_and_offsets_of_recording_and_video(rate_hz, fps, offset_s):
    markers, _ = make_markers(num_frames=200, rate_hz=rate_hz)
    truth = at_frames(markers, fps, 12, offset_s)
    # A frame at the very beginning of the recording has a position, whatever the rounding of its time.
    first = max(0, int(np.ceil(-offset_s * fps - 1e-9)))
    assert np.flatnonzero(truth.seen[:, 0])[0] == first
    expected_m = paths_m(np.arange(first, 12) / fps + offset_s, 2) + CROSS_M.mean(axis=0)
    # The error of a cubic spline: 5/384 dt^4 times 16 m/s^4, larger at its ends; a straight line has 0.8 mm at 25 Hz.
    np.testing.assert_allclose(truth.position_m[first:], expected_m, rtol=0, atol=3e-5 * (25 / rate_hz) ** 2)


def walking(num_markers=12, num_frames=100) -> np.ndarray:
    """(frames, markers, 3): markers of a person, which swing by 5 to 25 cm relative to each other."""
    rng = np.random.default_rng(3)
    t = np.arange(num_frames)[:, None, None] / RATE_HZ
    place_m = rng.uniform([-0.4, -0.4, 0.5], [0.4, 0.4, 1.3], (num_markers, 3))
    swing_m = rng.uniform(0.05, 0.25, (num_markers, 3)) * np.sin(6 * t + rng.uniform(0, 6, (num_markers, 1)))
    return place_m + swing_m + t * [1.2, 0, 0]


def person_and_box(num_markers=12) -> Markers:
    box = make_markers(100, drones=("boite",))[0]
    return with_markers(box, [f"Anna:M{number}" for number in range(num_markers)], walking(num_markers))


def people(position_m) -> Markers:
    return Markers(tuple(f"M{number}" for number in range(position_m.shape[1])), position_m, RATE_HZ)


#: A person who stands still is rigid, but larger than a drone, or with more markers.
STILL_M = np.repeat(np.random.default_rng(0).uniform(0, [0.5, 0.4, 1.8], (12, 3))[None], 50, axis=0)
NOBODY_M = np.full((9, 5, 3), np.nan)
ONE = make_markers(drones=("cf1",))[0]
#: Name of the case -> markers, what the user says, words of the line.
BAD = {
    # Found: a person's C3D in a sequence's folder became drones without a word.
    "a person": (people(walking()), None,
                 "dron1, not rigid, distances vary by 386 mm (M0, M1, M2, M3, M4, M5 and 6 more); say which"),
    "a person who stands still": (people(STILL_M), None, "dron1, 1.8 m large"),
    "many markers": (people(np.repeat(STILL_M, 4, axis=1)[:, :40]), None, "dron1, 40 markers"),
    "a box beside a person": (person_and_box(), None, "boite, rigid (boite:boite1, boite:boite2 and 3 more); anna"),
    "a box beside many": (person_and_box(43), None, "anna, 43 markers (Anna:M0, Anna:M1 and 41 more); say which"),
    "no labels": (Markers(("*1", "*2", "*3", "*4"), walking(4), RATE_HZ), None,
                  "found unidentified markers only (*1, *2, *3, *4); say which markers are a drone's with --body"),
    "one frame": (make_markers(1, drones=("cf1",))[0], None, "cf1, seen together in one frame at most"),
    "nothing seen": (Markers(make_markers(9)[0].labels[:5], NOBODY_M, 100.0), None,
                     "expected three markers of a drone in some frame, found none"),
    "a name of none": (ONE, {"cf1": ["b9"]}, "body cf1, R01_D2.c3d: expected labels of cf1:cf11, cf1:cf12, "),
    "a name of two": (with_markers(ONE, ["cf2:cf11"], 0.0), {"cf1": ["cf11"]}, "one marker called 'cf11', found 2"),
}  # fmt: skip


@pytest.mark.parametrize(("markers", "named", "words"), BAD.values(), ids=BAD)
def test_markers_that_are_no_drone_for_certain(tmp_path, markers, named, words):
    assert_refused(lambda: marker_bodies(markers, WHERE, named), "R01_D2.c3d", words, unchanged=tmp_path)


@pytest.mark.parametrize("named", [["boite:"], ["boite:boite1", "boite2", "boite3", "boite4", "boite5"]])
def test_the_user_says_which_markers_are_a_drone(named, caplog):
    truth = marker_bodies(person_and_box(), WHERE, {"cf1": named})
    assert truth.drones == ("cf1",)
    centroid_m = make_markers(100, drones=("boite",))[1]
    np.testing.assert_allclose(truth.position_m, centroid_m, rtol=0, atol=1e-9)
    assert not caplog.records
    marker_bodies(person_and_box(), WHERE, {"Anna": ["Anna:"]})
    assert "body Anna is not rigid" in caplog.text


def test_rigid_bodies_with_names_of_their_own_are_taken_with_a_line(caplog):
    """A single marker beside them is left out: a flash for synchronisation, say."""
    markers, _ = make_markers(400, drones=("cf1", "cf2"))
    # Noise of a motion-capture system and swapped labels leave a body rigid.
    markers.position_m[:] += np.random.default_rng(0).normal(0, 5e-4, markers.position_m.shape)
    markers.position_m[:80, [0, 1]] = markers.position_m[:80, [1, 0]]
    assert marker_bodies(with_markers(markers, ["Sync:Sync"], 0.0), WHERE).drones == ("cf1", "cf2")
    assert "taken for drones, because their markers are rigid: cf1 (cf1:cf11, " in caplog.text


def test_labels_without_a_colon_are_one_drone():
    markers, centroid_m = make_markers(drones=("Dron2",))
    unlabelled = with_markers(Markers(tuple("ABCDE"), markers.position_m, RATE_HZ), ["*7"], 9.0)
    truth = marker_bodies(unlabelled, WHERE)
    assert truth.drones == ("dron1",)
    np.testing.assert_allclose(truth.position_m, centroid_m, rtol=0, atol=1e-12)

"""Two methods' tracks as one: made-up tracks of which every error is known."""

import numpy as np
import pytest

from psotrack.fusion import fuse_tracks
from psotrack.fusion.fusion import COMMON_CORRELATION
from psotrack.settings import MotionSettings
from psotrack.tracking import COMMON
from psotrack.trajectories import Arrival, DroneSizes, Status, Tracks

FPS, FRAMES = 25.0, 200
SETTINGS, MAX_COASTING_S = MotionSettings(), 0.5
#: Errors of the swarm are small along x and large along y; those of the lines the other way round.
SWARM_STD_M, LINES_STD_M = np.array([0.005, 0.02, 0.01]), np.array([0.02, 0.005, 0.01])


def paths(num_drones):
    """(frames, drones, 3): drones on circles, a metre apart."""
    angle = np.arange(FRAMES)[:, None] / FPS + 2.0 * np.arange(num_drones)
    height_m = np.broadcast_to(1.0 + np.arange(num_drones), angle.shape)
    return np.stack([np.cos(angle), np.sin(angle), height_m], axis=-1)


def tracked(truth_m, std_m, *, seed, factor=1.0, hidden=(), offset_m=(0.0, 0.0, 0.0), arrivals=()):
    """What a method would yield that measures the truth with such errors; hidden is (drone, first, last frame)."""
    rng = np.random.default_rng(seed)
    measured_m = truth_m + std_m * rng.standard_normal(truth_m.shape) + offset_m
    status = np.full(truth_m.shape[:2], int(Status.TRACKED))
    for drone, first, last in hidden:
        status[first:last, drone] = Status.LOST
    measured_m[status != Status.TRACKED] = np.nan
    covariance_m2 = np.broadcast_to(factor * np.diag(np.square(std_m)), (*truth_m.shape, 3))
    size_m = np.full((truth_m.shape[1], 3), 0.4)
    return Tracks(
        position_m=measured_m,
        velocity_m_s=np.zeros_like(measured_m),
        covariance_m2=covariance_m2,
        measured_m=measured_m,
        measured_covariance_m2=covariance_m2,
        fitness=np.where(status == Status.TRACKED, 0.5, 0.0),
        num_cameras=np.where(status == Status.TRACKED, 4, 0),
        status=status,
        measured_size_m=np.full(truth_m.shape, np.nan),
        sizes=DroneSizes(
            size_m, 0.1 * size_m, np.zeros(size_m.shape, int), np.full((len(size_m), 3), np.nan)
        ),
        arrivals=tuple(arrivals),
    )


def fuse(swarm, lines, **how):
    return fuse_tracks(swarm, lines, SETTINGS, fps=FPS, max_coasting_s=MAX_COASTING_S, **how)


def both(truth_m, swarm=None, lines=None, **how):
    first = tracked(truth_m, SWARM_STD_M, seed=0, **(swarm or {}))
    # Whose covariances the fusion takes to be of the cameras' disagreement alone.
    second = tracked(truth_m, LINES_STD_M, seed=1, factor=1 / COMMON, **(lines or {}))
    return first, second, fuse(first, second, **how)[0]


def test_information_adds_up():
    truth_m = paths(3)
    first, second, together = both(truth_m)
    # About each drone's own median, as the middle that counts is known no better; and by the median of that, as one
    # frame in 1000 is beyond the gate, where the swarm's alone counts.
    off_m = together.measured_m - truth_m
    std_m = 1.4826 * np.median(np.abs(off_m - np.median(off_m, axis=0)), axis=(0, 1))
    expected_m = 1 / np.sqrt(1 / SWARM_STD_M**2 + 1 / LINES_STD_M**2)
    # The spread of 600 is known to 4 % so.
    np.testing.assert_allclose(std_m, expected_m, rtol=0.1)
    # The lines have another error, that of the offset of the middles.
    _, middles = fuse(first, second)
    expected_m2 = 1 / (1 / SWARM_STD_M**2 + 1 / (LINES_STD_M**2 + middles.std_m**2))
    diagonal_m2 = np.diagonal(together.measured_covariance_m2, axis1=-2, axis2=-1)
    np.testing.assert_allclose(np.median(diagonal_m2, axis=0), expected_m2, rtol=1e-9)
    assert (together.status == Status.TRACKED).all()


def test_the_middle_of_a_silhouette_is_what_counts():
    """Boxes whose middles are 8 cm higher: nothing of that is seen in what comes of it."""
    truth_m = paths(2)
    _, _, together = both(truth_m, lines={"offset_m": (0.01, 0.0, 0.08)})
    off_m = (together.measured_m - truth_m).mean(axis=(0, 1))
    np.testing.assert_allclose(off_m, 0.0, atol=0.003)


def test_the_offset_of_the_middles_is_told_with_its_error():
    truth_m, off_m = paths(4), np.array([0.01, 0.0, 0.08])
    first = tracked(truth_m, SWARM_STD_M, seed=0)
    second = tracked(truth_m, LINES_STD_M, seed=1, factor=1 / COMMON, offset_m=off_m)
    # A tenth of the frames has another drone in its place.
    second.measured_m[20:40, 0] += 0.2
    _, middles = fuse(first, second)
    # A median of 200 differences, of errors that do not last.
    expected_m = np.sqrt(np.pi / 2 * (SWARM_STD_M**2 + LINES_STD_M**2) / FRAMES)
    # Never less, but for what is clipped of the tails; what looks as if it lasted, by chance, makes it more.
    assert (middles.std_m[1:] > 0.85 * expected_m).all()
    assert (middles.std_m[1:] < 2.0 * expected_m).all()
    assert (np.abs(middles.offset_m - off_m) < 4 * middles.std_m).all()


def test_an_offset_from_errors_that_last_is_known_less_well():
    truth_m = paths(1)
    first = tracked(truth_m, np.full(3, 1e-6), seed=0)
    second = tracked(truth_m, np.full(3, 1e-6), seed=1, factor=1 / COMMON)
    lasting_m = np.repeat(np.random.default_rng(2).normal(0.0, 0.01, (FRAMES // 10, 1, 3)), 10, axis=0)
    second.measured_m[:] += lasting_m
    _, middles = fuse(first, second)
    # 20 independent errors, not 200: from so few the spread is known to a quarter.
    expected_m = np.sqrt(np.pi / 2 / 20) * 0.01
    np.testing.assert_allclose(middles.std_m / expected_m, 1.0, atol=0.6)


def test_who_is_seen_by_one_alone_has_no_offset():
    truth_m = paths(3)
    swarm, lines = tracked(truth_m[:, :2], SWARM_STD_M, seed=0), tracked(truth_m[:, 1:], LINES_STD_M, seed=1)
    _, middles = fuse(swarm, lines)
    assert np.isfinite(middles.offset_m).all(axis=-1).tolist() == [False, True, False]
    np.testing.assert_array_equal(np.isnan(middles.offset_m), np.isnan(middles.std_m))


def test_a_place_by_the_lines_alone_is_as_uncertain_as_the_offset_makes_it():
    hidden = [(0, 50, 100)]
    first = tracked(paths(1), SWARM_STD_M, seed=0, hidden=hidden)
    second = tracked(paths(1), LINES_STD_M, seed=1, factor=1 / COMMON)
    together, middles = fuse(first, second)
    diagonal_m2 = np.diagonal(together.measured_covariance_m2[60, 0])
    np.testing.assert_allclose(diagonal_m2, LINES_STD_M**2 + middles.std_m[0] ** 2, rtol=1e-9)


def test_errors_of_the_same_foreground_say_less():
    """The best linear estimate of two that err alike: less sure than that of two that do not."""
    first, second, apart = both(paths(2))
    alike, middles = fuse(first, second, same_foreground=True)
    # Axis by axis the least variance of a weighted mean (Lagrange): 1 / (1' S^-1 1).
    one_m, other_m = SWARM_STD_M + 0 * middles.std_m, np.hypot(LINES_STD_M, middles.std_m)
    cross_m2 = COMMON_CORRELATION * one_m * other_m
    joint_m2 = np.moveaxis(np.array([[one_m**2, cross_m2], [cross_m2, other_m**2]]), (0, 1), (-2, -1))
    expected_m2 = 1 / np.linalg.inv(joint_m2).sum(axis=(-2, -1))
    diagonal_m2 = np.diagonal(alike.measured_covariance_m2, axis1=-2, axis2=-1)
    np.testing.assert_allclose(np.median(diagonal_m2, axis=0), expected_m2, rtol=1e-9)
    less = np.median(np.linalg.det(apart.measured_covariance_m2))
    assert np.median(np.linalg.det(alike.measured_covariance_m2)) > less


def test_what_only_the_blobs_of_the_same_foreground_show_is_no_drone():
    truth_m = paths(3)
    swarm, lines = tracked(truth_m[:, :2], SWARM_STD_M, seed=0), tracked(truth_m, LINES_STD_M, seed=1)
    assert fuse(swarm, lines)[0].status.shape[1] == 3
    assert fuse(swarm, lines, same_foreground=True)[0].status.shape[1] == 2


def test_where_one_does_not_see_a_drone_the_other_one_does():
    truth_m = paths(2)
    hidden = [(0, 50, 100)]
    first, second, together = both(truth_m, swarm={"hidden": hidden}, lines={"hidden": [(1, 120, 150)]})
    assert (together.status == Status.TRACKED).all()
    # Alone, moved by the offset of the middles and no more.
    moved_m = together.measured_m[50:100, 0] - second.measured_m[50:100, 0]
    assert np.ptp(moved_m, axis=0).max() < 1e-12
    np.testing.assert_array_equal(together.measured_m[120:150, 1], first.measured_m[120:150, 1])
    assert np.linalg.norm(together.position_m[50:100, 0] - truth_m[50:100, 0], axis=-1).max() < 0.06


def test_what_neither_sees_coasts_and_is_lost():
    truth_m = paths(1)
    hidden = {"hidden": [(0, 50, 100)]}
    _, _, together = both(truth_m, swarm=hidden, lines=hidden)
    status = together.status[:, 0]
    frames = round(MAX_COASTING_S * FPS)
    assert (status[50 : 50 + frames] == Status.COASTING).all()
    assert (status[50 + frames : 100] == Status.LOST).all()
    variance = np.trace(together.covariance_m2[49:100, 0], axis1=1, axis2=2)
    assert (np.diff(variance) > 0).all()


def test_drones_that_only_the_lines_know_come_after_the_others():
    truth_m = paths(3)
    swarm = tracked(truth_m[:, [2, 0]], SWARM_STD_M, seed=0, arrivals=[Arrival(3, 1, again=False)])
    arrivals = [Arrival(9, 0, again=False), Arrival(20, 1, again=True)]
    lines = tracked(truth_m, LINES_STD_M, seed=1, factor=1 / COMMON, arrivals=arrivals)
    together, _ = fuse(swarm, lines)
    np.testing.assert_allclose(together.measured_m, truth_m[:, [2, 0, 1]], atol=0.1)
    # The first of the lines' arrivals is of a drone that the swarm knows.
    assert together.arrivals == (Arrival(3, 1, again=False), Arrival(20, 2, again=True))
    assert together.sizes.size_m.shape == (3, 3)
    assert together.measured_size_m.shape == (FRAMES, 3, 3)


def test_where_they_disagree_it_is_the_swarm_that_counts():
    truth_m = paths(1)
    swarm = tracked(truth_m, SWARM_STD_M, seed=0)
    lines = tracked(truth_m, LINES_STD_M, seed=1, factor=1 / COMMON)
    lines.measured_m[80:90] += 0.5
    together, _ = fuse(swarm, lines)
    np.testing.assert_array_equal(together.measured_m[80:90], swarm.measured_m[80:90])


@pytest.mark.parametrize("who", ["swarm", "lines"])
def test_one_of_them_may_find_nobody(who):
    truth_m = paths(2)
    some, nobody = tracked(truth_m, SWARM_STD_M, seed=0), tracked(truth_m[:, :0], SWARM_STD_M, seed=0)
    pair = (some, nobody) if who == "swarm" else (nobody, some)
    together, _ = fuse(*pair)
    np.testing.assert_array_equal(together.measured_m, some.measured_m)


def test_nobody_may_find_anybody():
    nobody = tracked(paths(0), SWARM_STD_M, seed=0)
    assert fuse(nobody, nobody)[0].status.shape == (FRAMES, 0)

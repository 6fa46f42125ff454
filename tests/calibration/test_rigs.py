"""A rig from views of a board or from a moving point, against the rig that made them; and the world of a rig."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from board_rigs import (
    BOARD,
    SIZE_WH,
    WORLD_M,
    Errors,
    Scene,
    fly_point,
    gaps_of,
    relative_to_first,
    row_of_cameras,
)
from helpers import make_unnamed_rig, posed, simple_lens
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.calibration import (
    Board,
    BoardViews,
    GivenWorld,
    LensChoice,
    LensModel,
    LensViews,
    PointViews,
    advise,
    align,
    calibrate_by_point,
    calibrate_rig,
    covariance_of_centres,
    distance_between,
    figures_of,
    find_board_shifts,
    find_point_shifts,
    fit_world,
    known_lenses,
    read_world,
    views_of_detections,
    world_of_camera,
)
from psotrack.calibration.lens_models import lenses_at_size
from psotrack.calibration.rig.start import find_board_poses, fit_boards
from psotrack.errors import InputError
from psotrack.geometry import project
from psotrack.recordings import Detections, FrameTimes

RIG, FOUR = row_of_cameras(), row_of_cameras(4)


def off_px(rig, truth=RIG):
    """Largest error of a focal length or a principal point, pixels."""
    return np.abs(rig.cameras.K - truth.cameras.K).max()


def off_m(rig, truth=RIG):
    """Largest error of a camera's centre in the axes of the first camera, metres."""
    found = world_of_camera(rig, 0).rig(rig).cameras.centre_world
    true = world_of_camera(truth, 0).rig(truth).cameras.centre_world
    return np.linalg.norm(found - true, axis=-1).max()


def views_of(rig=RIG, board=BOARD, *, seed=0, instants=25, errors=None):
    return Scene(rig, board, errors or Errors(), instants).views(np.random.default_rng(seed))


# A board.


def test_exact_corners_give_the_exact_rig():
    calibrated = calibrate_rig(BOARD, views_of(errors=Errors(0.0), instants=8))
    assert off_px(calibrated.rig) < 0.05
    assert off_m(calibrated.rig) < 1e-4
    np.testing.assert_allclose(calibrated.rig.cameras.dist, RIG.cameras.dist, atol=2e-3)
    assert np.nanmax(calibrated.residual_px) < 0.01


def test_known_lenses_are_kept_and_the_floor_is_the_board():
    views = views_of(errors=Errors(0.05), instants=10, seed=4)
    views = replace(views, number=views.number + 100)
    calibrated = calibrate_rig(BOARD, views, LensChoice(known=known_lenses(RIG)), floor=103)
    assert off_m(calibrated.rig) < 0.005
    # z points out of the front of the board, which the cameras see.
    assert (calibrated.rig.cameras.centre_world[:, 2] > 0.5).all()
    np.testing.assert_allclose(calibrated.T_world_board[3], np.diag([1.0, -1, -1, 1]), atol=1e-9)
    np.testing.assert_array_equal(calibrated.rig.cameras.K, RIG.cameras.K)
    assert all((std == 0).all() for std in calibrated.lens_std)


def test_lenses_of_images_of_another_size_are_rescaled_or_refused(caplog):
    """The middle of the first pixel is at 0, so that principal points change by half a pixel, too."""
    found = lenses_at_size(Path("lens.toml"), RIG, dict.fromkeys(RIG.names, (640, 360)))
    middle_px = (RIG.cameras.K[:, :2, 2] + 0.5) / 2 - 0.5
    np.testing.assert_allclose(found.cameras.K[:, :2, 2], middle_px)
    np.testing.assert_allclose(found.cameras.K[:, 0, 0], RIG.cameras.K[:, 0, 0] / 2)
    assert "rescaled from 1280 x 720 to 640 x 360 pixels" in caplog.text
    with pytest.raises(InputError, match="expected images of 1280 x 720 pixels"):
        lenses_at_size(Path("lens.toml"), RIG, dict.fromkeys(RIG.names, (640, 400)))


@pytest.mark.slow
def test_cameras_are_joined_by_a_chain():
    """Only neighbours of four cameras see the board together; the stated deviations grow along the chain and hold."""
    views = views_of(FOUR, instants=60, seed=1)
    pixels = views.corners_px.copy()
    pair = np.arange(60) % 3
    for camera in range(4):
        sees = (pair == camera) | (pair == camera - 1)
        pixels[camera, ~sees] = np.nan
    calibrated = calibrate_rig(BOARD, replace(views, corners_px=pixels))
    assert off_m(calibrated.rig, FOUR) < 0.02
    assert off_px(calibrated.rig, FOUR) < 10
    std_m = np.sqrt(np.trace(calibrated.centre_covariance_m2, axis1=1, axis2=2))
    assert (np.diff(std_m) > 0).all()
    assert off_m(calibrated.rig, FOUR) < 3 * std_m[3]


@pytest.mark.parametrize("turn_deg", [30, 60])
def test_a_board_whose_first_corner_is_beside_a_wide_lens(turn_deg):
    """Regression: such a view had no pose, or a wrong one, because the board's origin is behind the image plane."""
    R = Rotation.from_euler("YZ", [turn_deg, 180], degrees=True)
    places = R.apply(BOARD.corners_m) + np.array([0.9, 0.2, -0.1])
    hidden = places[:, 2] <= 0.1
    assert 6 < (~hidden).sum() < len(hidden)
    places[hidden] = np.nan
    pixels = 300 * places[:, :2] / places[:, 2:] + (640, 360)
    views = LensViews(BOARD, pixels[None], SIZE_WH)
    left_px = fit_boards(views, LensModel(0), np.array([300.0, 300, 640, 360]))
    assert (left_px[0, ~hidden] < 1e-6).all()


def test_a_view_without_a_pose():
    """OpenCV finds no pose for corners that a lens which is far off spreads widely: it raised a ValueError here."""
    rays = np.full((BOARD.num_corners, 2), np.nan)
    rays[[2, 3, 4, 5, 6, 10]] = (
        (-7.29174349, 3.4839081),
        (-3.19852923, 1.91519946),
        (-1.86380688, 1.45114178),
        (-1.16451996, 1.25125318),
        (-0.70326222, 1.16208221),
        (-9.454937, 6.42719423),
    )
    assert find_board_poses(BOARD, rays).shape == (0, 4, 4)


def test_a_single_marker_and_known_lenses():
    """Four corners have two poses that are nearly as likely; the views of all cameras decide."""
    marker = Board((1, 1), 0.25, 0.25, kind="grid", first_marker=7)
    views = views_of(RIG, marker, instants=30, seed=1)
    calibrated = calibrate_rig(marker, views, LensChoice(known=known_lenses(RIG)))
    worst_m2 = calibrated.centre_covariance_m2[1:].max(axis=0)
    # Five standard deviations of the worst camera, all of which are a few millimetres.
    assert off_m(calibrated.rig) < 5 * np.sqrt(np.trace(worst_m2))
    assert off_m(calibrated.rig) < 0.02


@pytest.mark.slow
def test_false_corners_do_not_matter():
    rng = np.random.default_rng(2)
    views = views_of(seed=2)
    pixels = views.corners_px.copy()
    false = rng.random(pixels.shape[:3]) < 0.03
    pixels[false] += rng.normal(0, 30, (false.sum(), 2))
    # A whole view that is of another board.
    first = np.argmax(views.seen[1])
    pixels[1, first] += rng.normal(0, 40, pixels.shape[2:])
    clean = calibrate_rig(BOARD, views)
    robust = calibrate_rig(BOARD, replace(views, corners_px=pixels))
    assert off_m(robust.rig, clean.rig) < 0.004
    false &= np.isfinite(pixels[..., 0])
    assert not robust.used[false].any()


@pytest.mark.slow
def test_a_chessboard_that_looks_alike_when_turned():
    """Each view has its corners in one of the two orders that look alike."""
    board = Board((9, 7), 0.1, kind="chessboard")
    rng = np.random.default_rng(3)
    views = views_of(RIG, board, seed=3)
    pixels = views.corners_px.copy()
    assert len(board.labellings) == 2
    for camera, instant in np.ndindex(pixels.shape[:2]):
        order = rng.choice(board.labellings)
        pixels[camera, instant] = pixels[camera, instant, order]
    calibrated = calibrate_rig(board, replace(views, corners_px=pixels))
    assert off_m(calibrated.rig) < 0.02
    assert np.nanmedian(calibrated.residual_px) < 0.4


def moved_board(count):
    """A board that is turned and moved smoothly before the cameras, as a hand does."""
    t = np.arange(float(count))[:, None] / 8
    angles = [-1.4 - 0.4 * np.sin(0.5 * t), 0.5 * np.sin(0.31 * t), 0.4 * np.cos(0.4 * t)]
    R = Rotation.from_euler("xyz", np.hstack(angles)).as_matrix()
    place = np.hstack([0.4 * np.sin(0.35 * t), 0.3 * np.cos(0.28 * t), 1.1 + 0.3 * np.sin(0.5 * t)])
    return (BOARD.corners_m - BOARD.corners_m.mean(axis=0)) @ R.mT + place[:, None]


@pytest.mark.parametrize("step", [1, 2, 5])
@pytest.mark.parametrize("late", [(0, 0, 0), (0, 0, 3), (0, 12, 25), (90, 0, 62)], ids=str)
def test_videos_that_begin_late_are_counted_to_a_single_frame(late, step):
    """Not all frames are searched for the board; nothing is known of the cameras' places."""
    corners_m, number = moved_board(592), np.arange(0, 500, step)
    pixels = [project(RIG.cameras[k], corners_m[number + begins])[0] for k, begins in enumerate(late)]
    pixels = np.array(pixels) + np.random.default_rng(11).normal(0, 0.3, (3, len(number), 35, 2))
    views = BoardViews(RIG.names, np.tile([1280, 720], (3, 1)), number, pixels)
    np.testing.assert_array_equal(
        find_board_shifts(BOARD, views, known_lenses(RIG)), late[0] - np.array(late)
    )


def test_advice_names_few_shared_views():
    views = views_of(seed=2)
    pixels = views.corners_px.copy()
    shared = np.flatnonzero(views.seen.all(axis=0))
    pixels[2, shared[3:]] = np.nan
    pixels[:2, ~views.seen.all(axis=0)] = np.nan
    calibrated = calibrate_rig(BOARD, replace(views, corners_px=pixels), LensChoice(known=known_lenses(RIG)))
    assert any(sentence.startswith("c2 shares 3 views with c") for sentence in advise(calibrated))
    assert figures_of(calibrated)["c2"]["shared"] == 3


@pytest.mark.slow
@pytest.mark.parametrize("errors", [Errors(0.1, view_px=0.3), Errors(0.1, slip_m=0.003)], ids=str)
def test_stated_deviations_hold(errors):
    """The truth lies within two standard deviations as often as it should, also if corners have errors in common."""
    true = world_of_camera(RIG, 0).rig(RIG).cameras
    inside, sizes = [], []
    for seed in range(3):
        calibrated = calibrate_rig(BOARD, views_of(errors=errors, instants=30, seed=seed))
        found = calibrated.rig.cameras
        for camera in (1, 2):
            off = found.centre_world[camera] - true.centre_world[camera]
            std = np.sqrt(np.diag(calibrated.centre_covariance_m2[camera]))
            inside += (np.abs(off) < 2 * std).tolist()
            sizes.append(np.linalg.norm(std))
        for camera, std in enumerate(calibrated.lens_std):
            off_K = found.K[camera] - true.K[camera]
            off = np.array([off_K[0, 0], off_K[1, 1], off_K[0, 2], off_K[1, 2]])
            inside += (np.abs(off) < 2 * std[:4]).tolist()
    # 95 % for a normal distribution; 18 values of a seed, which depend on each other somewhat.
    assert np.mean(inside) > 0.8
    assert np.median(sizes) < 0.03


# A moving point.


def fly(rng, points_m, false=0.05):
    """Pixels of a point in four cameras, and the sightings among them that are of something else."""
    pixels, _ = project(FOUR.cameras, points_m[:, None])
    pixels = pixels + rng.normal(0, 0.5, pixels.shape)
    wrong = rng.random(pixels.shape[:2]) < false
    pixels[wrong] += rng.normal(0, 200, (wrong.sum(), 2))
    return pixels, wrong


def views_at(pixels, rig=FOUR):
    return PointViews(rig.names, np.zeros(len(pixels), np.int64), np.arange(len(pixels)), pixels)


def test_a_moving_point_places_all_cameras():
    pixels, wrong = fly(np.random.default_rng(0), fly_point())
    # The last camera joins late: it shares nothing with the first one.
    pixels[::2, 0] = np.nan
    pixels[1::2, 3] = np.nan
    found = calibrate_by_point(FOUR, views_at(pixels))
    factor = distance_between(FOUR, "c0", "c3") / distance_between(found.rig, "c0", "c3")
    rig = world_of_camera(found.rig, 0, factor).rig(found.rig)
    np.testing.assert_allclose(rig.cameras.T_cam_world[0], np.eye(4), atol=1e-9)
    np.testing.assert_allclose(gaps_of(rig), gaps_of(FOUR), atol=0.03)
    seen = np.isfinite(pixels[..., 0])
    assert not found.used[wrong & seen].any()
    assert found.used[seen & ~wrong].mean() > 0.95
    # The median distance is 1.2 standard deviations, of which a fit takes a part away.
    assert 0.3 < np.median(found.residual_px[found.used]) < 0.8


@pytest.mark.parametrize("late", [0, 20])
def test_a_camera_that_is_late_by_many_instants_is_named(late):
    """The point flies at 1 m/s, 30 instants per second, with false sightings; each ten seconds it rests for three."""
    rests, seconds = np.divmod(np.arange(900) / 30, 10)
    flown = np.minimum(seconds, 7) + rests * 7
    path = [0.8 * np.sin(flown), 0.8 * np.cos(0.7 * flown), 1.1 + 0.5 * np.sin(1.3 * flown)]
    pixels, _ = fly(np.random.default_rng(0), np.stack(path, axis=-1))
    pixels[late:, 3] = pixels[: len(pixels) - late, 3]
    views = views_at(pixels)
    shifts = find_point_shifts(calibrate_by_point(FOUR, views).rig, views)
    assert [shift.camera for shift in shifts] == ["c3"] * bool(late)
    if late:
        # A shift of one instant moves a sighting by about ten pixels, which is beyond the gate.
        assert abs(shifts[0].instants + late) <= 1
        assert "c3 shows the scene late by about" in str(shifts[0])


def test_stated_deviations_hold_in_the_world_of_the_point():
    """Errors that last over twelve instants, as those of a detector do; the world is fixed by the point's positions."""
    points_m = fly_point()
    given = GivenWorld(Path("world.csv"), {str(k): place for k, place in enumerate(points_m)}, {})

    def world_of(found):
        numbered = dict(zip(found.views.number.tolist(), found.points_m, strict=True))
        change, _ = fit_world(found.rig, given, numbered, with_scale=True)
        return change

    squares = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        pixels, _ = fly(rng, points_m, false=0.0)
        pixels += np.repeat(rng.normal(0, 1.0, (5, 4, 2)), 12, axis=0)
        found = calibrate_by_point(FOUR, views_at(pixels))
        centres = world_of(found).points(np.asarray(found.rig.cameras.centre_world))
        off = centres - FOUR.cameras.centre_world
        variance = np.einsum("cii->ci", covariance_of_centres(found, world_of))
        squares += (off**2 / variance).ravel().tolist()
    # 24 values, of which the 12 of a seed depend on each other; a normal distribution has a median of 0.45.
    assert 0.1 < np.median(squares) < 2.0


@pytest.mark.parametrize("seed", [1, 2])
def test_cameras_with_a_small_field_of_view(seed):
    """Two telephoto cameras 10 m apart and a drone 70 to 100 m away: poses that are far off have errors of a few px.

    Regression: with a gate of 15 px alone, the first pose was off by degrees, on flights before real thermal cameras
    with these lenses too, and many sightings were left out.
    """
    lens = simple_lens(1176.0, (640, 480))
    rig = make_unnamed_rig(*(posed(lens, (x, 0.0, 1.0), (0.4 * x, 80.0, 30.0)) for x in (-5.0, 5.0)))
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 60, 200)[:, None] * [0.5, 0.23, 0.37 + np.pi / 120] + rng.uniform(0, 6, 3)
    points_m = np.array([0.0, 85.0, 31.0]) + np.array([20.0, 15.0, 10.0]) * np.sin(angle)
    pixels, _ = project(rig.cameras, points_m[:, None])
    pixels = pixels + rng.normal(0, 0.5, (200, 2, 2))
    found = calibrate_by_point(rig, views_at(pixels, rig))
    assert found.used.all(axis=1).mean() > 0.95
    turn = relative_to_first(found.rig)[1, :3, :3] @ relative_to_first(rig)[1, :3, :3].T
    assert Rotation.from_matrix(turn).magnitude() < np.radians(0.5)


def test_one_box_of_a_frame_counts():
    """The box of highest confidence counts; of two that are equal none does."""
    xyxy = np.zeros((5, 4))
    xyxy[:, 2:] = [[10, 10], [30, 30], [10, 10], [5, 5], [7, 7]]
    frame = np.array([0, 0, 1, 3, 3])
    confidence = np.array([0.9, 0.95, 0.5, 0.5, 0.5])
    boxes = Detections(frame, xyxy, confidence)
    times = FrameTimes(4, 25.0)
    views = views_of_detections({"a": boxes, "b": boxes}, {"a": times, "b": times})
    np.testing.assert_array_equal(views.points_px[:, 0, 0], [14.5, 4.5, np.nan, np.nan])


# The world.


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 10))
def test_alignment_finds_a_similarity(seed, scale):
    rng = np.random.default_rng(seed)
    points_m = rng.normal(0, 2, (5, 3))
    R = Rotation.random(rng=rng).as_matrix()
    t_m = rng.normal(0, 5, 3)
    change, left_m = align(points_m, scale * points_m @ R.T + t_m, with_scale=True)
    np.testing.assert_allclose(change.R, R, atol=1e-9)
    np.testing.assert_allclose(change.scale, scale, atol=1e-8 * scale)
    np.testing.assert_allclose(change.t_m, t_m, atol=1e-8 * scale)
    assert left_m.max() < 1e-7
    # A rig that moves with its points sees them at the same pixels.
    before, _ = project(RIG.cameras, points_m[:, None])
    moved = change.rig(RIG)
    after, _ = project(moved.cameras, change.points(points_m)[:, None])
    good = np.isfinite(before) & (np.abs(before) < 1e4)
    np.testing.assert_allclose(after[good], before[good], atol=1e-3)


def test_a_world_of_cameras_and_of_marked_points(tmp_path):
    centres_m = np.asarray(FOUR.cameras.centre_world)
    turned = world_of_camera(FOUR, 1).rig(FOUR)
    places = tmp_path / "places.csv"
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in zip(FOUR.names, centres_m, strict=True)]
    places.write_text("\n".join(["point,x_m,y_m,z_m", *rows]) + "\n")
    marks = tmp_path / "marks.csv"
    rows = ["camera,point,x_px,y_px,x_m,y_m,z_m"]
    for camera in (0, 1):
        pixels, _ = project(FOUR.cameras[camera], WORLD_M)
        for number, values in enumerate(np.hstack([pixels, WORLD_M])):
            rows.append(",".join([f"c{camera}", f"p{number}", *map(str, values)]))
    # A place may be in any of a point's rows.
    marks.write_text(
        "\n".join([*rows[:-3], *(",".join([*row.split(",")[:4], ",,"]) for row in rows[-3:])]) + "\n"
    )
    for path in (places, marks):
        change, left_m = fit_world(turned, read_world(path), with_scale=False)
        np.testing.assert_allclose(change.rig(turned).cameras.centre_world, centres_m, atol=1e-6)
        assert max(left_m.values()) < 1e-6

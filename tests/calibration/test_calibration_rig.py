"""A rig from views of a board: corners from the projection's formula, against the rig that made them."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from board_rigs import BOARD, SIZE_WH, Errors, Scene, relative_to_first, row_of_cameras
from scipy.spatial.transform import Rotation

from psotrack.calibration import (
    Board,
    BoardViews,
    LensChoice,
    LensModel,
    advise,
    calibrate_rig,
    figures_of,
    find_board_shifts,
    known_lenses,
)
from psotrack.calibration.rig.lenses import find_board_poses, fit_boards
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import project

RIG = row_of_cameras()


def off_px(rig, truth=RIG):
    """Largest error of a focal length or a principal point, pixels."""
    return np.abs(rig.cameras.K - truth.cameras.K).max()


def off_m(rig, truth=RIG):
    """Largest error of a camera's centre in the axes of the first camera, metres."""
    centres = [
        -np.einsum("cji,cj->ci", T[:, :3, :3], T[:, :3, 3]) for T in map(relative_to_first, (rig, truth))
    ]
    return np.linalg.norm(centres[0] - centres[1], axis=-1).max()


def test_exact_corners_give_the_exact_rig():
    views = Scene(RIG, errors=Errors(0.0), instants=8).views(np.random.default_rng(0))
    calibrated = calibrate_rig(BOARD, views)
    assert off_px(calibrated.rig) < 0.05
    assert off_m(calibrated.rig) < 1e-4
    np.testing.assert_allclose(calibrated.rig.cameras.dist, RIG.cameras.dist, atol=2e-3)
    assert np.nanmax(calibrated.residual_px) < 0.01


@pytest.mark.slow
def test_cameras_are_joined_by_a_chain():
    """Only neighbours of four cameras see the board together; the stated deviations grow along the chain and hold."""
    truth = row_of_cameras(4)
    views = Scene(truth, instants=90).views(np.random.default_rng(1))
    pixels = views.corners_px.copy()
    for camera in range(4):
        pair = np.arange(90) % 3
        pixels[camera, (pair != camera) & (pair != camera - 1)] = np.nan
    calibrated = calibrate_rig(BOARD, replace(views, corners_px=pixels))
    assert (calibrated.shared > 0).tolist() == (abs(np.subtract.outer(range(4), range(4))) < 2).tolist()
    assert off_m(calibrated.rig, truth) < 0.02
    assert off_px(calibrated.rig, truth) < 8
    std_m = np.sqrt(np.trace(calibrated.centre_covariance_m2, axis1=1, axis2=2))
    assert (np.diff(std_m) > 0).all()
    assert off_m(calibrated.rig, truth) < 3 * std_m[3]


def test_progress_of_lenses_and_adjustment():
    bars = {}

    @contextlib.contextmanager
    def report(description, total):
        bars[description] = [total, 0]

        def advance(steps):
            bars[description][1] += steps

        yield advance

    views = Scene(row_of_cameras(2), errors=Errors(0.1), instants=6).views(np.random.default_rng(0))
    calibrate_rig(BOARD, views, LensChoice(None), report=report)
    assert list(bars) == ["lenses", "adjustment"]
    assert all(0 < steps <= total for total, steps in bars.values())


@pytest.mark.parametrize("turn_deg", [30, 60])
def test_a_board_whose_first_corner_is_beside_a_wide_lens(turn_deg):
    """Regression: such a view had no pose, or a wrong one, because the board's origin is behind the image plane."""
    R = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix() @ np.diag([-1.0, -1.0, 1.0])
    places = BOARD.corners_m @ R.T + (0.9, 0.2, -0.1)
    seen = places[:, 2] > 0.1
    assert 6 < seen.sum() < len(seen)
    pixels = np.where(seen[:, None], 300 * places[:, :2] / places[:, 2:] + (640, 360), np.nan)
    off_px = fit_boards(BOARD, LensModel(0), np.array([300.0, 300, 640, 360]), pixels[None], SIZE_WH)
    assert (off_px[0, seen] < 1e-6).all()


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


@pytest.mark.slow
def test_a_single_marker_and_known_lenses():
    """Four corners have two poses that are nearly as likely; the views of all cameras decide."""
    marker = Board((1, 1), 0.25, 0.25, kind="grid", first_marker=7)
    views = Scene(RIG, marker, instants=40).views(np.random.default_rng(1))
    calibrated = calibrate_rig(marker, views, LensChoice(known=known_lenses(RIG)))
    # Five standard deviations of the worst camera, all of which are a few millimetres.
    assert off_m(calibrated.rig) < 5 * np.sqrt(np.trace(calibrated.centre_covariance_m2[1:].max(axis=0)))
    assert off_m(calibrated.rig) < 0.02


@pytest.mark.slow
def test_false_corners_do_not_matter():
    rng = np.random.default_rng(2)
    views = Scene(RIG).views(rng)
    pixels = views.corners_px.copy()
    false = rng.random(pixels.shape[:3]) < 0.03
    pixels[false] += rng.normal(0, 30, (int(false.sum()), 2))
    # A whole view that is of another board.
    pixels[1, int(np.flatnonzero(views.seen[1])[0])] += rng.normal(0, 40, pixels.shape[2:])
    clean, robust = (calibrate_rig(BOARD, replace(views, corners_px=p)) for p in (views.corners_px, pixels))
    assert off_m(robust.rig, clean.rig) < 0.004
    assert not robust.used[false & np.isfinite(pixels[..., 0])].any()


@pytest.mark.slow
@pytest.mark.parametrize("squares_wh", [(9, 7), (7, 7)])
def test_a_chessboard_that_looks_alike_when_turned(squares_wh):
    """Each view has its corners in one of the two, or four, orders that look alike."""
    board = Board(squares_wh, 0.1, kind="chessboard")
    rng = np.random.default_rng(3)
    views = Scene(RIG, board).views(rng)
    pixels = views.corners_px.copy()
    assert len(board.labellings) == (2 if squares_wh == (9, 7) else 4)
    for camera, instant in np.ndindex(pixels.shape[:2]):
        pixels[camera, instant] = pixels[camera, instant, rng.choice(board.labellings)]
    calibrated = calibrate_rig(board, replace(views, corners_px=pixels))
    assert off_m(calibrated.rig) < 0.02
    assert np.nanmedian(calibrated.residual_px) < 0.4


@pytest.mark.slow
def test_the_floor_is_the_board():
    views = Scene(RIG, errors=Errors(0.05), instants=10).views(np.random.default_rng(4))
    views = replace(views, number=views.number + 100)
    calibrated = calibrate_rig(BOARD, views, floor=103)
    assert off_m(calibrated.rig) < 0.005
    # z points out of the front of the board, which the cameras see.
    assert (calibrated.rig.cameras.centre_world[:, 2] > 0.5).all()
    np.testing.assert_allclose(calibrated.T_world_board[3], np.diag([1.0, -1, -1, 1]), atol=1e-9)
    with pytest.raises(
        InputError, match="floor: expected a frame in which a camera sees the board, found frame 7"
    ):
        calibrate_rig(BOARD, views, floor=7)


@pytest.mark.slow
def test_known_lenses_are_kept():
    views = Scene(RIG).views(np.random.default_rng(5))
    known = known_lenses(RIG)
    calibrated = calibrate_rig(BOARD, views, LensChoice(known=known))
    np.testing.assert_array_equal(calibrated.rig.cameras.K, RIG.cameras.K)
    assert all((std == 0).all() for std in calibrated.lens_std)


@pytest.mark.slow
@pytest.mark.parametrize("coefficients", [0, 4, 8])
def test_lens_models(coefficients):
    dist = (0.0,) * 5 if coefficients == 0 else (-0.2, 0.05, 0.001, 0.0005, 0.0)
    truth = row_of_cameras(2, dist)
    views = Scene(truth, errors=Errors(0.05)).views(np.random.default_rng(7))
    calibrated = calibrate_rig(BOARD, views, LensChoice(LensModel(coefficients)))
    assert off_m(calibrated.rig, truth) < 0.01
    assert np.nanmedian(calibrated.residual_px) < 0.08


def test_too_little_is_refused():
    views = Scene(RIG).views(np.random.default_rng(8))
    pixels = views.corners_px.copy()
    pixels[1, 4:] = np.nan
    with pytest.raises(InputError, match=r"camera c1: expected at least 5 views of 6 corners.*found [0-4]"):
        calibrate_rig(BOARD, replace(views, corners_px=pixels))
    pixels = views.corners_px.copy()
    pixels[2, ::2], pixels[:2, 1::2] = np.nan, np.nan
    with pytest.raises(
        InputError, match="no instant at which one of c0, c1 and one of c2 see the board together"
    ):
        calibrate_rig(BOARD, replace(views, corners_px=pixels))
    with pytest.raises(SettingsError, match="coefficients, found 6"):
        LensModel(6)


@pytest.mark.slow
def test_advice_names_what_is_missing():
    views = Scene(RIG, instants=40).views(np.random.default_rng(9))
    pixels = views.corners_px.copy()
    shared = np.flatnonzero(views.seen[2] & views.seen[:2].any(axis=0))
    pixels[2, shared[3:]] = np.nan
    alone = Scene(RIG, instants=40).views(np.random.default_rng(10)).corners_px
    alone[:2] = np.nan
    number = np.arange(80)
    calibrated = calibrate_rig(
        BOARD, replace(views, number=number, corners_px=np.concatenate([pixels, alone], axis=1))
    )
    assert any(sentence.startswith("c2 shares 3 views with c") for sentence in advise(calibrated))
    assert figures_of(calibrated)["c2"]["shared"] == 3


@pytest.mark.slow
def test_a_video_that_begins_late_is_named():
    """The board moves smoothly; frame n of the last camera is frame n + 1 of the others."""
    rng, t = np.random.default_rng(11), np.arange(40.0)
    pixels = np.full((3, 40, BOARD.num_corners, 2), np.nan)
    middle = BOARD.corners_m.mean(axis=0)
    for instant in t:
        turn = [1.4 + 0.4 * np.sin(0.5 * instant), 0.5 * np.sin(0.31 * instant), 0.4 * np.cos(0.4 * instant)]
        place = [
            0.4 * np.sin(0.35 * instant),
            0.3 * np.cos(0.28 * instant),
            1.1 + 0.3 * np.sin(0.5 * instant),
        ]
        R = Rotation.from_euler("xyz", [-turn[0], turn[1], turn[2]]).as_matrix()
        seen = project(RIG.cameras, ((BOARD.corners_m - middle) @ R.T + place)[:, None])[0]
        pixels[:, int(instant)] = seen.swapaxes(0, 1) + rng.normal(0, 0.1, (3, BOARD.num_corners, 2))
    pixels[2, :-1], pixels[2, -1] = pixels[2, 1:].copy(), np.nan
    views = BoardViews(RIG.names, np.tile([1280, 720], (3, 1)), np.arange(40), pixels)
    calibrated = calibrate_rig(BOARD, views)
    (shift,) = find_board_shifts(calibrated)
    assert (shift.camera, shift.instants) == ("c2", 1)
    assert str(shift).startswith("c2 shows the scene early by about 1 instants: ")
    assert str(shift) in advise(calibrated)


@pytest.mark.slow
@pytest.mark.parametrize("errors", [Errors(0.2), Errors(0.1, view_px=0.3), Errors(0.1, slip_m=0.003)])
def test_stated_deviations_hold(errors):
    """The truth lies within two standard deviations as often as it should, also if corners have errors in common."""
    inside, sizes = [], []
    for seed in range(6):
        calibrated = calibrate_rig(
            BOARD, Scene(RIG, errors=errors, instants=30).views(np.random.default_rng(seed))
        )
        centres, true = calibrated.rig.cameras.centre_world, np.linalg.inv(relative_to_first(RIG))
        for camera in (1, 2):
            off = centres[camera] - true[camera, :3, 3]
            std = np.sqrt(np.diag(calibrated.centre_covariance_m2[camera]))
            inside += (np.abs(off) < 2 * std).tolist()
            sizes.append(np.linalg.norm(std))
        for camera, std in enumerate(calibrated.lens_std):
            K = calibrated.rig.cameras.K[camera] - RIG.cameras.K[camera]
            inside += (np.abs([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) < 2 * std[:4]).tolist()
    # 95 % for a normal distribution; 108 values that depend on each other somewhat.
    assert np.mean(inside) > 0.86
    assert np.median(sizes) < 0.03

"""Bad input of the room: each is refused in one line that says what was expected and found, where, and the remedy."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pandas as pd
import pytest
from board_rigs import (
    BOARD,
    Scene,
    draw_board,
    film_board,
    fly_point,
    random_poses,
    record_detections,
    row_of_cameras,
    write_pairs,
)
from clock_worlds import random_motion, simulate_estimate, simulate_reference
from helpers import assert_refused, make_once, ring_rig

from psotrack.calibration import (
    Board,
    LensChoice,
    LensModel,
    PointViews,
    align,
    calibrate_by_point,
    calibrate_rig,
    detect_board,
    distance_between,
    find_views,
    fit_world,
    instants_of_numbers,
    lens_of_view,
    locate_camera,
    open_images,
    read_point_views,
    read_world,
)
from psotrack.calibration.clocks import camera_offsets
from psotrack.calibration.rig.moving_point import adjust
from psotrack.evaluation import find_offset
from psotrack.geometry import look_at, make_camera, project
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections

RIG, FOUR = row_of_cameras(3), row_of_cameras(4)
HELD = Board((7, 5), 0.04, 0.03)


def calls(function, *arguments, **options):
    """A call that needs no file."""
    return lambda folder, run: partial(function, *arguments, **options)


def runs(words):
    """A command on the files of `files`."""
    return lambda folder, run: partial(run, words)


def calibrates(options):
    return runs(f"calibrate rig --out {{new}} {options}")


def reads(text, read, name="points.csv"):
    """A file of this text is read."""

    def prepare(folder, run):
        (folder / name).write_text(text)
        return partial(read, folder / name)

    return prepare


def pairs(before, after):
    """Marks of two cameras are read after a change of their table."""

    def prepare(folder, run):
        write_rig(folder / "rig.toml", ring_rig(2, image_size_wh=(1920, 1080)))
        path = write_pairs(folder / "pairs.csv", ring_rig(2, image_size_wh=(1920, 1080)))
        path.write_text(path.read_text().replace(before, after, 1))
        return lambda: run("calibrate rig --pairs {tmp}/pairs.csv --lenses {tmp}/rig.toml --out {new}")

    return prepare


def marks(*rows, header="camera,point,x_px,y_px,x_m,y_m,z_m"):
    def prepare(folder, run):
        (folder / "pairs.csv").write_text("\n".join([header, *rows]) + "\n")
        return lambda: run("calibrate rig --pairs {tmp}/pairs.csv --fov 60,40 --size 640,480 --out {new}")

    return prepare


def films(poses):
    """A board is filmed, and its camera calibrated."""

    def prepare(folder, run):
        cameras = open_images([film_board(folder / "board.avi", poses)])

        def call():
            found = find_views(HELD, cameras, instants_of_numbers(cameras))
            return calibrate_rig(found.board, found.views, LensChoice(LensModel(4)))

        return call

    return prepare


def blind_camera(folder, run):
    """One of two cameras never sees the board."""
    shown = draw_board(
        HELD, np.diag([620.0, 620.0, 1.0]) + 240 * np.eye(3, k=2), next(random_poses()), (640, 480)
    )
    for name, image in (("a", shown), ("b", np.zeros((480, 640), np.uint8))):
        (folder / name).mkdir()
        for number in range(2):
            cv2.imwrite(str(folder / name / f"{number}.png"), image)
    cameras = open_images([folder / "a", folder / "b"])
    return lambda: find_views(HELD, cameras, instants_of_numbers(cameras))


def flat_poses(count, step_m, distance_m, turn_deg=3.0):
    """Poses of a board that is turned and moved in the plane of the image alone."""
    for i in range(count):
        T = np.eye(4)
        angle = np.deg2rad(turn_deg * i)
        T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        T[:3, 3] = np.array([step_m * i, 0, distance_m]) - T[:3, :3] @ [0.14, 0.1, 0]
        yield T


def board_views(change):
    """Views of a board, some corners of which are taken away."""
    views = Scene(RIG).views(np.random.default_rng(8))
    pixels = views.corners_px.copy()
    change(pixels)
    return calls(calibrate_rig, BOARD, replace(views, corners_px=pixels))


def few_views(pixels):
    pixels[1, 4:] = np.nan


def apart(pixels):
    pixels[2, ::2], pixels[:2, 1::2] = np.nan, np.nan


def offsets(path, *, max_offset_s=1.0, offset_s=0.2, **others):
    """The clock of a reference with this path is sought by noisy tracks."""
    estimate = simulate_estimate(path, offset_s=offset_s, noise_m=0.02, **others)
    return calls(find_offset, estimate, *simulate_reference(path), max_offset_s=max_offset_s)


def finds(estimate, time_s, max_offset_s=1.0):
    return calls(find_offset, estimate, time_s, TRUTH_M, max_offset_s=max_offset_s)


def calibrates_point(pixels):
    return calls(calibrate_by_point, FOUR, point_views(pixels))


def fit_read_world(path):
    return fit_world(FOUR, read_world(path), with_scale=False)


def straight(speed_m_s):
    return lambda t: np.stack([speed_m_s * np.asarray(t), 0 * t, 1 + 0 * t], axis=-1)


def circle(time_s):
    angle = 2 * np.pi * np.asarray(time_s) / 0.8
    return np.stack([np.cos(angle), np.sin(angle), 1 + 0 * angle], axis=-1)


# Points before a camera.
RNG = np.random.default_rng(9)
K = np.array([[1157.0, 0, 959.5], [0, 1157.0, 539.5], [0, 0, 1]])
R, T_M = look_at((4.0, 3.0, 2.0), (0.0, 0.0, 1.0))
CAMERA = make_camera(R=R, t_m=T_M, K=K, image_size_wh=(1920, 1080))
POINTS_M = RNG.uniform((-1, -1, 0), (1, 1, 2), (12, 3))
PIXELS = project(CAMERA, POINTS_M)[0]
LINE_M = np.array([0, 0, 1.0]) + np.arange(5)[:, None] * np.array([0.2, 0.1, 0.05])
BROKEN_M = np.where(np.arange(36).reshape(12, 3) == 7, np.nan, POINTS_M)
#: A sheet of 20 cm at a distance of 8 m, tilted a little, looks the same if it is tilted to the other side.
SHEET_M = np.array([(x, y, 0) for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.1)])
SHEET_POSE = look_at((0.9, 0.0, 8.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
SHEET_CAMERA = make_camera(R=SHEET_POSE[0], t_m=SHEET_POSE[1], K=K, image_size_wh=(1920, 1080))
SHEET_PX = project(SHEET_CAMERA, SHEET_M)[0] + np.random.default_rng(0).normal(0, 0.5, (6, 2))
located = partial(calls, locate_camera, name="camera c7")


def point_views(pixels):
    count = np.arange(len(pixels))
    return PointViews(FOUR.names, np.zeros_like(count), count, pixels)


FLOWN_PX = project(FOUR.cameras, fly_point()[:, None])[0]
WITHOUT_C2 = np.where(np.arange(4)[:, None] == 2, np.nan, FLOWN_PX)
#: Two cameras see one half of the points, and the two others the rest.
HALVES_PX = np.where((np.arange(4) < 2)[:, None] == (np.arange(60) < 30)[:, None, None], np.nan, FLOWN_PX)
FEW_OF_C1 = np.where((np.arange(4)[:, None] == 1) & (np.arange(60)[:, None, None] > 4), np.nan, FLOWN_PX)
LINE, SPREAD = np.arange(4.0)[:, None] * [1.0, 2.0, 0.5], np.eye(4, 3)
TWO_ENDS = "camera,frame,point,x_px,y_px\n" + "c0,0,tip,1,1\n" * 2
SUN = "point,x_m,y_m,z_m\nc0,0,0,0\nc1,1,0,0\nsun,1,1,1\n"
ESTIMATE, (TIME_S, TRUTH_M) = simulate_estimate(random_motion(0)), simulate_reference(random_motion(0))
UNSEEN = replace(ESTIMATE, position_m=np.full_like(ESTIMATE.position_m, np.nan))
GREY = [np.full((240, 320), 128, np.uint8)] * 3

#: Name of the case -> how the bad input is made, and words of the line.
BAD = {
    # Marks, and points of known place.
    "point twice": (pairs("c1,p3,", "c1,p2,"), "line 19, column point", "once per camera, found p2 again"),
    "unknown point": (pairs("c1,p3,", "c1,p99,"), "line 19, column point: expected x_m, y_m, z_m in one of"),
    "no column": (pairs("x_px", "u"), "pairs.csv: expected a column x_px"),
    "no name": (pairs("c0,p0,", "c0,,"), "line 2, column point: expected a value, found nothing"),
    "no number": (pairs("c0,p0,", "c0,p0,x"), "line 2, column x_px: expected a number"),
    "more values": (pairs("c0,p0,", "c0,p0,1,2,3,"), "line 2: expected 7 values as in the header, found 10"),
    "no lens of it": (pairs("c1,p3,", "c9,p3,"), "rig.toml: expected the lens of c9, found only c0, c1"),
    "two places": (marks("c0,p,1,2,0,0,1", "c1,p,3,4,0,0,2"), "line 3", "p at [0.0, 0.0, 1.0], as before"),
    "one point": (marks("c0,p,1,2,0,0,1"), "4 points of known position, found 1"),
    "no places": (marks("c0,p,1,2", header="camera,point,x_px,y_px"), "line 2", "or in a file of places"),
    "three points": (located(POINTS_M[:3], PIXELS[:3], CAMERA), "camera c7", "known position, found 3"),
    "a line": (located(LINE_M, project(CAMERA, LINE_M)[0], CAMERA), "camera c7", "not all on one line"),
    "not finite": (located(BROKEN_M, PIXELS, CAMERA), "camera c7", "NaN"),
    "mirrored": (located(POINTS_M * [1, -1, 1], PIXELS, CAMERA), "right-handed axes", "mirrored"),
    "mixed up": (located(POINTS_M, PIXELS[RNG.permutation(12)], CAMERA), "camera c7", "mixed up"),
    "small plane": (located(SHEET_M, SHEET_PX, SHEET_CAMERA), "camera c7", "two poses"),
    "no noise": (located(POINTS_M, PIXELS, CAMERA, 0.0), "noise_px"),
    # Boards and their views.
    "no board": (calls(detect_board, 0.04, GREY), "or a chessboard, found neither in 3 images"),
    "large marker": (calls(Board, (7, 5), 0.04, 0.05), "board.marker_m"),
    "two rows": (calls(Board, (7, 2), 0.04, 0.03), "at least 3 x 3 squares"),
    "dictionary": (calls(Board((7, 5), 0.04, 0.03, "9x9").opencv), "dictionary", "4x4_50", "found 9x9"),
    "coefficients": (calls(LensModel, 6), "coefficients, found 6"),
    "field of view": (calls(lens_of_view, 180.0, 60.0, (640, 480)), "between 0 and 180"),
    "four views": (films(flat_poses(4, 0.0, 0.4, 0.0)), "at least 5 views of 6 corners"),
    "flat views": (films(flat_poses(10, 0.003, 0.4)), "views that determine the focal length"),
    # The fit ended at a focal length of 320 000 px, with which the boards seem tilted, and that lens was accepted.
    "flat, far": (films(flat_poses(10, 0.005, 0.45)), "views that determine the focal length"),
    "few views": (board_views(few_views), "camera c1: expected at least 5 views of 6 corners"),
    "apart": (board_views(apart), "no instant at which one of c0, c1 and one of c2 see the board together"),
    "blind camera": (blind_camera, "camera b: expected views of the board", "found none in 2 frames"),
    "no floor": (calls(calibrate_rig, BOARD, Scene(RIG).views(RNG), floor=70), "floor: ", "found frame 70"),
    "camera twice": (calls(open_images, ["a/board", "a/board"]), "each camera once, found board again"),
    "no images": (calls(open_images, ["top*.png"]), "images of this pattern, found none"),
    "one name": (calls(open_images, ["a/board", "b/board"], ["a"]), "2 names, found 1"),
    # A moving point, and the world.
    "few instants": (calibrates_point(FLOWN_PX[:8]), "points: expected at least 12 instants"),
    "unseen by one": (calibrates_point(WITHOUT_C2), "camera c2: expected at least 12 instants"),
    "few of one": (calls(adjust, FOUR, point_views(FEW_OF_C1)), "c1: expected at least 6 points", "found 5"),
    "two halves": (calls(adjust, FOUR, point_views(HALVES_PX)), "cameras: expected points that connect all"),
    "no camera top": (calls(distance_between, FOUR, "c0", "top"), "two of c0, c1, c2, c3, found c0,top"),
    "end twice": (reads(TWO_ENDS, read_point_views), "each point once per camera and frame, found 0 of c0"),
    "two of three": (reads(SUN, fit_read_world), "found 2 of 3"),
    "a line given": (calls(align, SPREAD, LINE, with_scale=True), "not on one line, found 4 on a line"),
    "a line seen": (calls(align, LINE, SPREAD, with_scale=True), "as the rig knows them; check the lenses"),
    # Clocks.
    "hardly moves": (offsets(random_motion(0, 0.01)), "the offset to a frame, 0.04 s, found a"),
    "hovers": (offsets(straight(0.0)), "if the drones hover"),
    "flies on": (offsets(straight(1.0)), "found a standard deviation"),
    "circles": (offsets(circle, max_offset_s=1.2), "one offset that fits best", "narrow the range"),
    "out of range": (offsets(random_motion(0), max_offset_s=0.3, offset_s=0.9), "end of the range, +0.3 s"),
    "no common time": (offsets(random_motion(0), start_s=60.0), "of both at offsets within 1 s, found none"),
    "small range": (finds(ESTIMATE, TIME_S, 0.001), "expected a step of the reference, 0.01 s"),
    "back in time": (finds(ESTIMATE, TIME_S[::-1]), "reference at two increasing times"),
    "one frame": (
        finds(ESTIMATE.at_frames(np.array([5])), TIME_S),
        "estimate of two frames or more, found 1",
    ),
    "never seen": (finds(UNSEEN, TIME_S), "found none"),
    "five of four": (calls(camera_offsets, FOUR, np.zeros((9, 1, 5, 2)), 25.0), "4 cameras, found 5"),
    "no offsets": (calls(camera_offsets, FOUR, np.zeros((9, 1, 4, 2)), 0.0), "fps"),
    # The commands.
    "two ways": (calibrates("--pairs a --markers b"), "found --pairs and --markers"),
    "no way": (calibrates("a b"), "expected one of --square, --squares, --points, --pairs, --markers"),
    "lens of a board": (calibrates("a.mp4 --square 0.04 --fov 60,40"), "--fov: expected points or markers"),
    "no lens": (calibrates("--pairs {pairs}"), "--lenses: expected a calibration with the lens of"),
    "two lenses": (calibrates("--pairs {pairs} --fov 60,40 --lenses {lenses}"), "found both"),
    "no size": (calibrates("--pairs {pairs} --fov 60,40"), "--size: expected width and height"),
    "a video": (calibrates("a.mp4 --pairs {pairs} --lenses {lenses}"), "--pairs: expected no video"),
    "a world": (calibrates("--pairs {pairs} --world {pairs} --lenses {lenses}"), "--world: expected none"),
    "no scale": (calibrates("{light} --points --lenses {lenses}"), "and --world FILE, found none"),
    "two scales": (calibrates("{light} --points --lenses {lenses} --distance c0,c2=1 --stick 1"), "found 2"),
    "one end": (calibrates("{light} --points --lenses {lenses} --stick 1"), "two ends of a stick"),
    "far floor": (calibrates("{board} --squares 7x5 --square 0.04 --marker 0.03 --floor 99"), "one is 13"),
    "inches": (runs("calibrate convert {lenses} {new} --units inch"), "one of m, cm, mm, found inch"),
    "one side": (runs("calibrate convert c.csv {new} --size 320"), "expected two whole numbers above 0"),
    "fx, fy": (runs("calibrate convert {lenses} {tmp}/a.csv"), "expected one focal length, found fx"),
    "without places": (runs("doctor {unplaced}"), "lens and place are known, found none for left, right"),
}


def make_files(folder):
    write_rig(folder / "lenses.toml", RIG)
    write_pairs(folder / "pairs.csv", RIG)
    film_board(folder / "board.avi")
    rows = [{"camera": name, "frame": k, "x_px": 1, "y_px": 1} for name in RIG.names for k in range(20)]
    pd.DataFrame(rows).to_csv(folder / "light.csv", index=False)
    one = Detections(np.arange(5), np.tile([0, 0, 9, 9.0], (5, 1)), np.ones(5))
    record_detections(folder / "unplaced", {"left": one, "right": one})


@pytest.mark.parametrize(("prepare", "words"), [(one, words) for one, *words in BAD.values()], ids=BAD)
def test_bad_input_is_refused_in_one_line(prepare, words, tmp_path_factory, run_psotrack, tmp_path):
    files = make_once(tmp_path_factory, "calibration_files", make_files)

    def run(line):
        paths = {path.stem: path for path in files.iterdir()} | {
            "tmp": tmp_path,
            "new": tmp_path / "new.toml",
        }
        return run_psotrack(*(word.format(**paths) for word in line.split()))

    assert_refused(prepare(tmp_path, run), *words, unchanged=tmp_path)

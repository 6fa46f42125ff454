"""Rooms with markers, the cameras that look at them, what these detect, and the files of a drawn flight."""

import shutil

import cv2
import numpy as np
from dpjait_folders import make_simulated
from helpers import posed, simple_lens
from marker_pictures import draw
from scipy.spatial.transform import Rotation

from psotrack.calibration import lens_of_view
from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import make_rig, project
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import VideoWriter
from psotrack.recordings.datasets import write_marker_corners

#: Corners of a square of side 1, clockwise from the top left one, as seen from its front; z points out of the front.
SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
RATE_HZ = 25.0


#: A camera with a little distortion.
LENS = simple_lens(900.0, (1280, 720), (-0.08, 0.02, 0.0004, -0.0003))


def marker_at(centre_m, front, turn_deg=0.0, *, side_m=0.3):
    """Corners (4, 3) of a marker whose front looks along `front`, turned in its plane, metres."""
    front = np.array(front, float) / np.linalg.norm(front)
    above = np.array([0, 0, 1.0])
    if abs(front[2]) >= 0.9:
        above = np.array([0, 1.0, 0])
    beside = np.cross(above, front)
    beside /= np.linalg.norm(beside)
    axes = np.stack([beside, np.cross(front, beside), front])
    spin = Rotation.from_euler("z", turn_deg, degrees=True)
    return np.array(centre_m, float) + side_m * spin.apply(SQUARE) @ axes


#: Where the front of a marker looks.
EAST, WEST, NORTH, SOUTH = (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)
UP, DOWN = (0, 0, 1), (0, 0, -1)


def four_walls():
    """Four markers of 0.4 m on each wall of a room of 8 x 6 m, at changing heights; ids from 1."""
    corners = {}
    for x, y, inward in ((0, 3, SOUTH), (4, 0, WEST), (0, -3, NORTH), (-4, 0, EAST)):
        along = np.abs([inward[1], inward[0], 0])
        for index, shift_m in enumerate((-2.1, -0.7, 0.8, 2.2)):
            middle_m = np.array([x, y, 1.2 + 0.5 * (index % 3)])
            corners[len(corners) + 1] = marker_at(middle_m + shift_m * along, inward, side_m=0.4)
    return corners


def any_room():
    """Markers on walls, on a pillar in front of a wall, on the floor and on the ceiling, turned any way."""
    corners = {}
    for i in range(6):
        corners[i] = marker_at((-3 + 1.2 * i, 4, 1 + 0.5 * (i % 3)), SOUTH, 37 * i)
    for i in range(5):
        corners[10 + i] = marker_at((4, -2 + 1.3 * i, 1.2 + 0.4 * (i % 2)), WEST, 90 * i)
    corners[20] = marker_at((0.2, 3.2, 1.3), SOUTH)
    corners[21] = marker_at((0.5, 3.5, 1.4), EAST, 10)
    corners[22] = marker_at((-0.1, 3.5, 1.9), WEST)
    corners[23] = marker_at((0.2, 3.8, 1.6), NORTH, 45)
    corners[30] = marker_at((1.5, 2.5, 0), UP, 20)
    corners[31] = marker_at((-1.5, 2, 0), UP, 200)
    corners[40] = marker_at((1, 2.5, 3), DOWN, 70)
    corners[41] = marker_at((-1, 3, 3), DOWN)
    return corners


def column_names(pattern, corners="1234"):
    """Header of a table with a row for each marker."""
    return ["id", *(pattern.format(axis=axis, corner=corner) for corner in corners for axis in "xyz")]


OUR_COLUMNS = column_names("{axis}{corner}[m]")


def _table(header, rows, separator):
    """Text of a table; without a header if it is None."""
    lines = [separator.join(map(str, row)) for row in rows]
    if header:
        lines.insert(0, separator.join(header))
    return "\n".join(lines) + "\n"


def wide_table(corners_m, header=OUR_COLUMNS, *, scale=1.0, separator=";"):
    """Text of a table with a row for each marker."""
    rows = [(marker, *(scale * corners).ravel()) for marker, corners in corners_m.items()]
    return _table(header, rows, separator)


def long_table(corners_m, header, corner_names="1234", *, scale=1.0, separator=","):
    """Text of a table with a row for each corner."""
    rows = []
    for marker, corners in corners_m.items():
        for name, corner in zip(corner_names, corners, strict=True):
            rows.append((marker, name, *(scale * corner)))
    return _table(header, rows, separator)


def found_markers(ids, corners_px, std_px=np.nan):
    """Detected markers, (markers, 4, 2), pixels."""
    corners_px = np.array(corners_px, float).reshape(-1, 4, 2)
    return DetectedMarkers(np.array(ids, int), corners_px, np.full(len(corners_px), std_px))


def whole_markers(corners_m, camera, pixels, depth_m):
    """(markers,), markers whose front and whole border a camera shows at (markers, 4, 2) pixels."""
    front = np.cross(corners_m[:, 3] - corners_m[:, 1], corners_m[:, 2] - corners_m[:, 0])
    to_camera = camera.centre_world - corners_m.mean(axis=1)
    faces = np.vecdot(to_camera, front) > 0.01
    inside = ((pixels > 0) & (pixels < camera.image_size_wh - 1)).all(axis=(1, 2))
    # The polynomial of the distortion folds back far outside of the image.
    T = camera.T_cam_world
    x_cam = corners_m @ T[:3, :3].T + T[:3, 3]
    narrow = np.abs(x_cam[..., :2]).max(axis=-1) < 1.2 * depth_m
    return faces & inside & (narrow & (depth_m > 0.3)).all(axis=1)


def seen_markers(corners_m, camera, rng, noise_px, std_px=np.nan):
    """The markers that a camera detects, with errors of their corners."""
    ids, points_m = np.array(list(corners_m)), np.array(list(corners_m.values()))
    pixels, depth_m = project(camera, points_m)
    seen = whole_markers(points_m, camera, pixels, depth_m)
    shown_px = pixels[seen]
    error_px = noise_px * rng.standard_normal(shown_px.shape)
    return found_markers(ids[seen], shown_px + error_px, std_px)


#: A camera that flies past the markers of `any_room`.
PASSING_CAMERA = simple_lens(700.0, (1280, 960))


def fly_past(num_frames, noise_px=0.3):
    """Number, time and detected markers of the frames of a camera that flies past `any_room`, and its positions."""
    rng, frames, centres_m = np.random.default_rng(0), [], []
    for number in range(num_frames):
        share = number / num_frames
        centre_m = np.array([-1.5 + 3 * share, -1.5 + 0.5 * share, 1.2 + 0.4 * np.sin(5 * share)])
        ahead = np.array([np.sin(0.5 * share), np.cos(0.5 * share), 0.05])
        view = posed(PASSING_CAMERA, centre_m, centre_m + ahead)
        found = seen_markers(any_room(), view, rng, noise_px, std_px=noise_px)
        frames.append((number, number / RATE_HZ, found))
        centres_m.append(centre_m)
    return frames, np.array(centres_m)


# A drawn flight before two walls, as files that a user would have.

DRAWN_LENS = lens_of_view(70.0, 55.4, (640, 480))
NUM_FRAMES = 14
#: Number of the frame with only three markers, and of the frame without markers.
FEW_MARKERS_FRAME, NO_MARKERS_FRAME = 6, 8
#: Markers of the frame with few, and a marker that is on no map.
FEW, UNMAPPED = (5, 8, 17), 900


def wall_markers():
    """Nine markers on a wall at y = 4, and four on a wall at x = 3; ids with gaps."""
    corners = {}
    for i in range(9):
        row, column = divmod(i, 3)
        corners[5 + 3 * i] = marker_at((-1.45 + 1.3 * column, 4, 0.85 + 0.75 * row), SOUTH)
    for i in range(4):
        row, column = divmod(i, 2)
        corners[40 + i] = marker_at((3, 2.35 + 0.8 * column, 1.05 + 0.9 * row), WEST)
    return corners


def drawn_cameras():
    """The camera in each frame, which flies to the right, forward and up."""
    cameras = []
    for i in range(NUM_FRAMES):
        centre_m = (-0.9 + 0.12 * i, -0.3 + 0.04 * i, 1.2 + 0.04 * i)
        target_m = (0.5 + 0.03 * i, 4.0, 1.5)
        cameras.append(posed(DRAWN_LENS, centre_m, target_m))
    return cameras


def draw_markers(corners_m, camera):
    """Colour image of the markers that a camera shows whole."""
    size_wh = tuple(int(side) for side in camera.image_size_wh)
    points_m = np.array(list(corners_m.values())).reshape(-1, 4, 3)
    pixels, depth_m = project(camera, points_m)
    seen = whole_markers(points_m, camera, pixels, depth_m)
    shown = [(marker, at) for marker, at, there in zip(corners_m, pixels, seen, strict=True) if there]
    return cv2.cvtColor(draw(shown, size_wh=size_wh, fine=4), cv2.COLOR_GRAY2BGR)


def make_drawn_flight(folder):
    """Write `flight.avi`, its `images`, the lens, `lens.toml`, and the markers' corners, `corners.csv`."""
    write_marker_corners(folder / "corners.csv", wall_markers())
    write_rig(folder / "lens.toml", make_rig({"front": DRAWN_LENS}))
    (folder / "images").mkdir()
    with VideoWriter(folder / "flight.avi", RATE_HZ, (640, 480)) as writer:
        for number, camera in enumerate(drawn_cameras()):
            shown = wall_markers() | {UNMAPPED: marker_at((0.15, 3.9, 0.45), (0, -1, 0))}
            if number == FEW_MARKERS_FRAME:
                shown = {marker: shown[marker] for marker in (*FEW, UNMAPPED)}
            image = draw_markers({} if number == NO_MARKERS_FRAME else shown, camera)
            # File names without leading zeros: 10 must come after 9.
            cv2.imwrite(str(folder / "images" / f"frame{number}.png"), image)
            writer.write(image)
    return folder


def write_onboard_sequence(drawn, folder):
    """Write a sequence in the dataset's layout, where the videos of two drones' own cameras are the drawn flight's."""
    make_simulated(folder)
    for number in (1, 2):
        shutil.copy(drawn / "flight.avi", folder / f"dron{number}_cam_s.avi")
    shutil.copy(drawn / "corners.csv", folder / "aruco_corners.csv")
    K = DRAWN_LENS.K
    rows = [f"dron{number};{K[0, 0]};{K[1, 1]};319.5;239.5;640;480\n" for number in (1, 2)]
    header = "cam_name;focal_length_x;focal_length_y;cx;cy;width;height\n"
    (folder / "drone_cameras_calibration.csv").write_text("".join([header, *rows]))
    # A picture in the folder does not make it a folder of images.
    cv2.imwrite(str(folder / "plot.png"), np.zeros((20, 30), np.uint8))
    return folder

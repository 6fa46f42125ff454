"""Boards, marked points and flying points that a rig sees, by the formula of the projection, or drawn."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.calibration import Board, BoardViews
from psotrack.geometry import Rig, look_at, make_camera, make_rig, project
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import VideoWriter, write_detections

BOARD = Board((8, 6), 0.1, 0.075)
SIZE_WH = (1280, 720)


@dataclass(frozen=True)
class Errors:
    """Standard deviations of the errors of a view's corners.

    Attributes:
        corner_px: of each corner for itself.
        view_px: of all corners of a view together.
        slip_m: shift of the board as a camera sees it.
    """

    corner_px: float = 0.2
    view_px: float = 0.0
    slip_m: float = 0.0


@dataclass(frozen=True)
class Scene:
    """A rig, and how a board is seen by it."""

    rig: Rig
    board: Board = BOARD
    errors: Errors = field(default_factory=Errors)
    instants: int = 25

    def views(self, rng):
        """Views of the board at random poses, where at least half of its corners are in an image."""
        count, corners = len(self.rig), self.board.num_corners
        pixels = np.full((count, self.instants, corners, 2), np.nan)
        middle = self.board.corners_m.mean(axis=0)
        for instant in range(self.instants):
            # The board faces one of the cameras, more or less.
            towards = self.rig.cameras.centre_world[rng.integers(count)]
            place = rng.uniform((-0.6, -0.6, 0.6), (0.6, 0.6, 1.6))
            # z points away from the camera, into the board.
            z = (place - towards) / np.linalg.norm(place - towards)
            x = np.cross([0.0, 0.0, 1.0], z)
            x /= np.linalg.norm(x)
            R = np.column_stack([x, np.cross(z, x), z])
            R = R @ Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True).as_matrix()
            for camera in range(count):
                slip = rng.normal(0, self.errors.slip_m, 3) if self.errors.slip_m else 0.0
                points_m = (self.board.corners_m - middle) @ R.T + place + slip
                seen, depth = project(self.rig.cameras[camera], points_m)
                seen = seen + rng.normal(0, self.errors.corner_px, seen.shape)
                seen += rng.normal(0, self.errors.view_px, 2) if self.errors.view_px else 0.0
                faces = (points_m.mean(axis=0) - self.rig.cameras.centre_world[camera]) @ R[:, 2] > 0
                inside = ((seen > 0) & (seen < np.array(SIZE_WH) - 1)).all(axis=-1) & (depth > 0.2) & faces
                if inside.mean() > 0.5:
                    pixels[camera, instant, inside] = seen[inside]
        sizes = np.tile(np.array(SIZE_WH), (count, 1))
        return BoardViews(self.rig.names, sizes, np.arange(self.instants), pixels)


def row_of_cameras(count=3, dist=(-0.2, 0.08, 0.001, -0.001, 0.0)):
    """Cameras in an arc that look at the middle of a room, each with a lens of its own."""
    cameras = {}
    for index in range(count):
        angle = np.deg2rad(-30.0 + 60.0 * index / max(count - 1, 1))
        R, t_m = look_at((3.0 * np.sin(angle), -3.0 * np.cos(angle), 1.5 + 0.2 * index), (0.0, 0.0, 1.1))
        K = np.array([[900.0 + 30 * index, 0, 640 - 5 * index], [0, 905.0 + 30 * index, 355], [0, 0, 1]])
        cameras[f"c{index}"] = make_camera(R=R, t_m=t_m, K=K, dist=dist, image_size_wh=SIZE_WH)
    return make_rig(cameras)


def relative_to_first(rig):
    """(cameras, 4, 4), transforms from the first camera to each camera."""
    T = rig.cameras.T_cam_world
    return T @ np.linalg.inv(T[0])


def draw_sheet(sheet, corner_px, per_m, K, T_cam_board, size_wh):
    """Grey image of a printed sheet, three times as large and then reduced.

    The board's origin lies at the outer corner of the sheet's pixel `corner_px`, and `per_m` pixels are a metre.
    """
    shift = (0.5 - corner_px) / per_m
    to_board = np.array([[1 / per_m, 0, shift], [0, 1 / per_m, shift], [0, 0, 1]])
    # If an image is enlarged three times, the centre of pixel p moves to 3 p + 1.
    to_large = np.array([[3.0, 0, 1], [0, 3, 1], [0, 0, 1]])
    H = to_large @ K @ T_cam_board[:3, [0, 1, 3]] @ to_board
    large = cv2.warpPerspective(sheet, H, (3 * size_wh[0], 3 * size_wh[1]), borderValue=200)
    return cv2.resize(large, size_wh, interpolation=cv2.INTER_AREA)


def draw_board(board, K, T_cam_board, size_wh):
    """Grey image of a ChArUco board that OpenCV draws."""
    per_m = 2500.0
    size_px = tuple(round(count * board.square_m * per_m) for count in board.squares_wh)
    return draw_sheet(board.opencv().generateImage(size_px), 0, per_m, K, T_cam_board, size_wh)


#: A board in the hand before one camera, and the camera's lens.
HELD, HELD_K = Board((7, 5), 0.04, 0.03), np.array([[620.0, 0, 322.0], [0, 625.0, 236.0], [0, 0, 1]])


def random_poses(count=14):
    """Poses of a board that is turned and moved before a camera."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3), degrees=True).as_matrix()
        middle_m = rng.uniform((-0.1, -0.08, 0.32), (0.1, 0.08, 0.55))
        T[:3, 3] = middle_m - T[:3, :3] @ [0.14, 0.1, 0]
        yield T


def film_board(path, poses=None, frames=1):
    """Write a video of the board in the hand, with as many frames of each pose."""
    with VideoWriter(path, 25.0, (640, 480)) as writer:
        for T in random_poses() if poses is None else poses:
            image = draw_board(HELD, HELD_K, T, (640, 480))
            for _ in range(frames):
                writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    return path


#: Points of known place in a room.
WORLD_M = np.random.default_rng(0).uniform((-1.5, -1.5, 0.2), (1.5, 1.5, 2.4), (14, 3))


def write_pairs(path, rig, *, noise_px=0.5, wrong=None):
    """Write marks of all points in all cameras; only the rows of the first camera have positions."""
    rng = np.random.default_rng(1)
    lines = ["camera,point,x_px,y_px,x_m,y_m,z_m"]
    for index, name in enumerate(rig.names):
        pixels = project(rig.cameras[index], WORLD_M)[0] + rng.normal(0, noise_px, (len(WORLD_M), 2))
        for number, (x, y) in enumerate(pixels):
            x += 80 if (name, number) == wrong else 0
            place = ",".join(map(repr, WORLD_M[number].tolist())) if index == 0 else ",,"
            lines.append(f"{name},p{number},{x},{y},{place}")
    path.write_text("\n".join(lines) + "\n")
    return path


def record_detections(folder, seen, rig=None):
    """Write a recording of detections by camera, which have no place without a rig."""
    folder.mkdir(exist_ok=True)
    lines = ["version = 1"]
    if rig is not None:
        write_rig(folder / "rig.toml", rig)
        lines.append('calibration = "rig.toml"')
    for name, boxes in seen.items():
        write_detections(folder / f"{name}.csv", boxes)
        lines += [f"[cameras.{name}]", f'detections = "{name}.csv"', "size = [1920, 1080]", "fps = 25.0"]
    (folder / "recording.toml").write_text("\n".join(lines) + "\n")
    return folder


def fly_point(instants=60):
    """Positions of a point that flies through the room."""
    t = np.linspace(0, 30, instants)
    return np.stack([0.8 * np.sin(t), 0.8 * np.cos(0.7 * t), 1.1 + 0.5 * np.sin(0.31 * t)], axis=-1)


def gaps_of(rig):
    """Distances between all cameras."""
    centres_m = np.asarray(rig.cameras.centre_world)
    return np.linalg.norm(centres_m[:, None] - centres_m, axis=-1)

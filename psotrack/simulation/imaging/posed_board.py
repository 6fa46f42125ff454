"""A ChArUco board in the room: where it is held, and how a camera sees it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from psotrack.calibration import Board
from psotrack.geometry import Rig, look_at, undistort
from psotrack.simulation.imaging.raster import Pinhole

Image = UInt8[np.ndarray, "height width 3"]

#: White edge around the squares, metres.
_EDGE_M = 0.03
#: Texels per metre of the board.
_TEXELS_PER_M = 800.0
#: Samples per pixel along each side.
_MAGNIFICATION = 4
#: Grey levels of black, of white, and of the back.
_BLACK, _WHITE, _BACK = 48.0, 208.0, 120.0
#: Lowest and highest place of the board's middle, metres; and how far it may be from the middle of the room.
_HEIGHT_M, _FARTHEST_M = (0.8, 2.1), np.array([3.0, 2.2])
#: Distance of the board from the camera whose image it is to fill, metres.
_DISTANCE_M = (1.8, 4.4)
#: Where the board lies on the floor: its first corner.
_FLOOR_M = (-0.5, 0.1, 0.0)
#: Second number of the random seed of the board's places.
_FOR_BOARD = 1_000_004


@dataclass(frozen=True)
class PosedBoard:
    """The board in one place.

    Attributes:
        axes: (3, 3), columns are the board's axes in the world: right, down, and away from who looks at its front.
        corner_m: first corner of the squares, world, metres.
    """

    axes: Float[np.ndarray, "3 3"]
    corner_m: Float[np.ndarray, "3"]


def own_board() -> Board:
    """The board: 4 x 5 squares of 25 cm, with other markers than those on the walls."""
    return Board((4, 5), 0.25, 0.19, "5x5_50")


def board_poses(rig: Rig, number: int, seed: int) -> tuple[PosedBoard, ...]:
    """Places of the board: first on the floor, then in the hands of a person who shows the board to all cameras.

    Each place is in the view of one camera after the other, anywhere in its image. Every second round the board is
    turned to the middle between this camera and the next one, so that neighbours see it together.

    Args:
        rig: the cameras, which stand side by side along x.
        number: number of places.
        seed: seed of the places.
    """
    rng = np.random.default_rng([seed, _FOR_BOARD])
    centres_m = np.asarray(rig.cameras.centre_world)
    # Neighbours are next to each other along the wall.
    order = np.argsort(centres_m[:, 0])
    places = [PosedBoard(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), np.array(_FLOOR_M))]
    width_m, height_m = np.array(own_board().squares_wh) * own_board().square_m
    while len(places) < number:
        turn, rounds = len(places) % len(rig), len(places) // len(rig)
        step = 1 if turn == 0 else -1 if turn == len(rig) - 1 else rng.choice([-1, 1])
        camera, beside = order[turn], order[turn + step]
        shared = rounds % 2 == 1
        middle_m = _in_view(rig, int(camera), rng)
        low_m, high_m = _HEIGHT_M
        if not (low_m <= middle_m[2] <= high_m and (np.abs(middle_m[:2]) <= _FARTHEST_M).all()):
            continue
        towards = rng.uniform(0.4, 0.6) if shared else rng.uniform(0.0, 0.2)
        target_m = centres_m[camera] + towards * (centres_m[beside] - centres_m[camera])
        away, _ = look_at(target_m.tolist(), middle_m.tolist())
        most_deg = 8.0 if shared else 30.0
        tilt = Rotation.from_euler("zxy", rng.uniform(-1, 1, 3) * [40.0, most_deg, most_deg], degrees=True)
        axes = away.T @ tilt.as_matrix()
        places.append(PosedBoard(axes, middle_m - axes[:, :2] @ [width_m / 2, height_m / 2]))
    return tuple(places)


def draw_board(image: Image, cam: Pinhole, board: PosedBoard) -> Image:
    """The image with the board drawn over it; nothing hides the board.

    Args:
        image: image of the room by a pinhole camera.
        cam: the camera.
        board: the board.
    """
    texture = _texture()
    rows, columns = texture.shape
    # Texel centres have integer coordinates.
    to_board = np.array(
        [
            [1 / _TEXELS_PER_M, 0, 0.5 / _TEXELS_PER_M - _EDGE_M],
            [0, 1 / _TEXELS_PER_M, 0.5 / _TEXELS_PER_M - _EDGE_M],
            [0, 0, 1],
        ]
    )
    to_camera = cam.R @ np.column_stack([board.axes[:, :2], board.corner_m]) + np.outer(cam.t_m, [0, 0, 1])
    H = cam.K @ to_camera @ to_board
    outline = np.array([[-0.5, -0.5], [columns - 0.5, -0.5], [columns - 0.5, rows - 0.5], [-0.5, rows - 0.5]])
    corners = np.c_[outline, np.ones(4)] @ H.T
    if corners[:, 2].min() < 0.1:
        return image
    pixels = corners[:, :2] / corners[:, 2:]
    x1, y1 = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
    x2, y2 = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, [cam.width, cam.height])
    if x1 >= x2 or y1 >= y2:
        return image
    if board.axes[:, 2] @ (board.corner_m + cam.R.T @ cam.t_m) < 0:
        texture = np.full_like(texture, _BACK)
    m = _MAGNIFICATION
    # Pixel p of the window is at m p + (m - 1) / 2 of the magnified window.
    enlarge = np.array([[m, 0, (m - 1) / 2 - m * x1], [0, m, (m - 1) / 2 - m * y1], [0, 0, 1.0]])
    size = (int(x2 - x1), int(y2 - y1))
    large = (m * size[0], m * size[1])
    seen = cv2.warpPerspective(
        texture, enlarge @ H, large, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    inside = np.zeros(large[::-1], np.uint8)
    polygon = np.c_[pixels, np.ones(4)] @ enlarge.T
    cv2.fillConvexPoly(inside, np.round(polygon[:, :2] * 16).astype(np.int32), 1, shift=4)
    share = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None]
    grey = cv2.resize(seen, size, interpolation=cv2.INTER_AREA)[..., None]
    drawn = image.copy()
    window = drawn[y1:y2, x1:x2]
    window[...] = np.clip(share * grey + (1 - share) * window + 0.5, 0, 255).astype(np.uint8)
    return drawn


@lru_cache(maxsize=1)
def _texture() -> Float[np.ndarray, "rows columns"]:
    """Grey levels of the board's front, with the white edge."""
    board = own_board()
    size = tuple(round(side * board.square_m * _TEXELS_PER_M) for side in board.squares_wh)
    front = board.opencv().generateImage((size[0], size[1]))
    edge = round(_EDGE_M * _TEXELS_PER_M)
    framed = cv2.copyMakeBorder(front, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=255)
    return (_BLACK + framed.astype(np.float32) / 255 * (_WHITE - _BLACK)).astype(np.float32)


def _in_view(rig: Rig, camera: int, rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A point somewhere in the image of a camera."""
    one = rig.cameras[camera]
    pixel = rng.uniform(0.06, 0.94, 2) * one.image_size_wh
    x, y = undistort(one, pixel)
    ray = np.array([x, y, 1.0])
    in_camera = ray / np.linalg.norm(ray) * rng.uniform(*_DISTANCE_M)
    T = np.asarray(one.T_cam_world)
    return T[:3, :3].T @ (in_camera - T[:3, 3])

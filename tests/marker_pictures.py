"""Pictures of ArUco markers, with their true corners: on flat and bent sheets, and at any four corners."""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from psotrack.foreground.markers import marker_dictionary
from psotrack.geometry import undistort

#: Grey levels of a marker's cells and of a plain wall, and the power of a sheet's grey levels that is light.
BLACK, WHITE, WALL, GAMMA = 35.0, 215.0, 140.0, 2.2
#: Samples per pixel of a sheet along each side.
FINE = 3
#: Corners of a marker in its own places, clockwise from the top left one.
OWN_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
#: Error of a sample's place on a sheet, pixels.
CONVERGED_PX = 1e-4
#: Distance of the camera from a sheet, in sides of the marker.
FAR = 5.0


@dataclass(frozen=True)
class Sheet:
    """A marker on a sheet of paper with one white cell around it.

    `turn` is its rotation in the image, `tilt` that about an axis in the image at the angle `axis`, rad. `bow` is the
    height of the bent sheet's middle over its ends, in sides of the marker.
    """

    marker: int
    centre: tuple[float, float]
    side_px: float
    turn: float = 0.0
    tilt: float = 0.0
    axis: float = 0.0
    bow: float = 0.0

    @property
    def R(self):
        about = np.array([np.cos(self.axis), np.sin(self.axis), 0]) * self.tilt
        return cv2.Rodrigues(about)[0] @ cv2.Rodrigues(np.array([0, 0, self.turn]))[0]

    def pixels(self, u, v):
        """Pixels of places on the sheet; the marker is from -0.5 to 0.5 along u and v."""
        points = np.stack([u, v, 4 * self.bow * (0.8 * u + 0.6 * v) ** 2], axis=-1) @ self.R.T
        return np.array(self.centre) + self.side_px * points[..., :2] * (FAR / (FAR + points[..., 2:]))

    @property
    def corners_px(self):
        return self.pixels(*OWN_CORNERS.T)


def _places(corners_px, lens, x, y):
    """Places on a flat marker that pixels show; its corners are undistorted ones where a lens is given."""
    H = cv2.getPerspectiveTransform(corners_px.astype(np.float32), OWN_CORNERS.astype(np.float32))
    points = np.stack([x, y], axis=-1)
    if lens is not None:
        points = undistort(lens, points) @ lens.K[:2, :2].T + lens.K[:2, 2]
    u, v, scale = np.moveaxis(points @ H[:, :2].T + H[:, 2], -1, 0)
    return u / scale, v / scale


def _places_on_bent(sheet, x, y):
    """Places on a bent sheet that pixels show, by Newton's method."""
    off_x, off_y = x - sheet.centre[0], y - sheet.centre[1]
    cos, sin = np.cos(sheet.turn) / sheet.side_px, np.sin(sheet.turn) / sheet.side_px
    u, v = off_x * cos + off_y * sin, off_y * cos - off_x * sin
    small = 1e-4
    for _ in range(5):
        at = sheet.pixels(u, v)
        # Far beyond the sheet a steep one has no place for a pixel, and none is needed.
        near = np.maximum(np.abs(u), np.abs(v)) < 1
        left_x, left_y = x - at[..., 0], y - at[..., 1]
        if np.hypot(left_x, left_y)[near].max(initial=0.0) < CONVERGED_PX:
            break
        by_u, by_v = (sheet.pixels(u + small, v) - at) / small, (sheet.pixels(u, v + small) - at) / small
        area = by_u[..., 0] * by_v[..., 1] - by_u[..., 1] * by_v[..., 0]
        u = np.clip(u + (left_x * by_v[..., 1] - left_y * by_v[..., 0]) / area, -2, 2)
        v = np.clip(v + (left_y * by_u[..., 0] - left_x * by_u[..., 1]) / area, -2, 2)
    return u, v


def _paint(image, marker, dictionary, corners_px, places, *, exponent, fine, inverted=False):  # noqa: PLR0913
    """Draw a marker with one white cell around it.

    Args:
        image: grey levels, which are changed.
        places: a function from pixels x and y to places u and v on the marker.
        fine: number of samples along each side of a pixel.
        exponent: the light of a pixel is the mean of its samples, and its grey level is this root of the light.
    """
    model = marker_dictionary(dictionary)
    cells = model.markerSize + 2
    white = cv2.aruco.generateImageMarker(model, marker, cells) > 0
    shown = np.pad(white, 1, constant_values=True) ^ inverted
    # The block of whole pixels that holds the marker and its white cells.
    margin, size_wh = np.ptp(corners_px, axis=0).max() / 4 + 1, image.shape[::-1]
    low = np.clip(np.floor(corners_px.min(axis=0) - margin), 0, size_wh).astype(int)
    high = np.clip(np.ceil(corners_px.max(axis=0) + margin), 0, size_wh).astype(int)
    axes = [(np.arange(fine * (b - a)) + 0.5) / fine - 0.5 + a for a, b in zip(low, high, strict=True)]
    u, v = places(*np.meshgrid(*axes))
    row, column = (np.floor((place + 0.5) * cells).astype(int) + 1 for place in (v, u))
    on_sheet = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < cells + 2)
    part = image[low[1] : high[1], low[0] : high[0]]
    levels = part.repeat(fine, 0).repeat(fine, 1)
    levels[on_sheet] = np.where(shown[row[on_sheet], column[on_sheet]], WHITE, BLACK)
    light = (levels / 255) ** exponent
    light = light.reshape(part.shape[0], fine, part.shape[1], fine).mean(axis=(1, 3))
    part[:] = 255 * light ** (1 / exponent)


def picture(  # noqa: PLR0913
    sheets,
    size_wh=(480, 360),
    dictionary="4x4_50",
    *,
    inverted=False,
    blur_px=0.7,
    noise=2.0,
    shaded=False,
    seed=0,
):
    """Grey picture of sheets before a wall with a texture and dark and light boards."""
    rng, (width, height) = np.random.default_rng(seed), size_wh
    coarse = rng.normal(0, 1, (height // 12 + 2, width // 12 + 2)).astype(np.float32)
    image = 140 + 15 * cv2.resize(coarse, size_wh, interpolation=cv2.INTER_CUBIC).astype(float)
    for _ in range(12):
        x, y = rng.uniform((0, 0), size_wh).astype(int)
        board_wh = rng.integers(width // 30, width // 6, 2)
        image[y : y + board_wh[1], x : x + board_wh[0]] = rng.uniform(20, 230)
    for sheet in sheets:
        corners_px = sheet.corners_px
        places = partial(_places_on_bent, sheet) if sheet.bow else partial(_places, corners_px, None)
        _paint(
            image, sheet.marker, dictionary, corners_px, places, exponent=GAMMA, fine=FINE, inverted=inverted
        )
    light = (np.clip(image, 0, 255) / 255) ** GAMMA
    light = cv2.GaussianBlur(light, (0, 0), blur_px) if blur_px else light
    if shaded:
        light = light * (0.1 + 0.9 / (1 + np.exp(-12 * (np.arange(width) / width - 0.5))))
    gray = 255 * light ** (1 / GAMMA) + rng.normal(0, noise, light.shape)
    return np.clip(np.round(gray), 0, 255).astype(np.uint8)


def rows_of_sheets(rng, count, size_wh, side_px, *, ids=50, tilt=0.6, bow=0.0):
    """Sheets in a grid over the picture, of random sizes, turns, tilts and bows."""
    cell = 2.3 * side_px[1]
    places = [
        (x, y) for y in np.arange(cell / 2, size_wh[1], cell) for x in np.arange(cell / 2, size_wh[0], cell)
    ]
    places = [(x, y) for x, y in places if x + cell / 2 <= size_wh[0] and y + cell / 2 <= size_wh[1]]
    names = rng.permutation(ids)
    return [
        Sheet(
            int(names[index]),
            (x + rng.uniform(0, 1), y + rng.uniform(0, 1)),
            np.exp(rng.uniform(*np.log(side_px))),
            rng.uniform(0, 2 * np.pi),
            rng.uniform(0, tilt),
            rng.uniform(0, 2 * np.pi),
            bow * rng.uniform(0.5, 1) * rng.choice([-1, 1]),
        )
        for index, (x, y) in enumerate(places[:count])
    ]


def draw(markers, *, size_wh=(640, 480), dictionary="4x4_1000", lens=None, exponent=2.0, fine=8):
    """Grey picture of a wall with markers at given corners, pairs of id and (4, 2) pixels, one ray for each sample."""
    drawn = np.full(size_wh[::-1], WALL)
    for marker, corners_px in markers:
        places = partial(_places, corners_px, lens)
        _paint(drawn, marker, dictionary, corners_px, places, exponent=exponent, fine=fine)
    return np.round(drawn).astype(np.uint8)

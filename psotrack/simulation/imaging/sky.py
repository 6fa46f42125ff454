"""A sky with clouds in the place of walls and ceiling; all cameras see the same clouds in the same direction.

The clouds are a smooth random function of azimuth, elevation and time, which repeats itself every 90 degrees.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.simulation.imaging import sensor
from psotrack.simulation.imaging.backdrop import Backdrop, lens_blur
from psotrack.simulation.imaging.raster import Pinhole

#: Third number of the random seed; those of `scenery` are smaller.
_FOR_CLOUDS = 4
#: Side of the picture that repeats itself, pixels, and the angle that it covers.
_TILE_PX, _TILE_RAD = 512, np.pi / 2
#: Cells per side of the largest clouds, number of sizes, each half of the one before, and their amplitudes' ratio.
_CELLS, _OCTAVES, _FAINTER = 4, 6, 0.55
#: Speed of the drift, of the nearer of two layers of clouds, and time in which one replaces the other and it returns.
_DRIFT_RAD_S, _NEARER, _CHANGE_S = np.radians(1.5), 1.15, 40.0
#: Light of the sky without clouds, BGR, and of clouds at full contrast.
_BLUE, _WHITE = np.array([0.6, 0.36, 0.2]), np.array([0.95, 0.93, 0.92])
#: The clouds are computed for every second pixel along each side.
_COARSER = 2
#: Standard deviation of the blur between sky and objects without the lens's blur, pixels.
_EDGE_PX = 0.4


class Sky:
    """The sky behind the hall in the image of a camera without distortion.

    Args:
        contrast: 0 to 1; the clouds' light between that of the blue sky and white.
        seed: seed of the simulation.
        cam: the camera.
        empty: the empty room in this camera's image.
        lens_blur_px: standard deviation of the lens's blur.
    """

    def __init__(
        self, contrast: float, seed: int, cam: Pinhole, empty: Backdrop, lens_blur_px: float
    ) -> None:
        x, y, width, height = cv2.boundingRect(empty.shell.astype(np.uint8))
        self._window = slice(y, y + height), slice(x, x + width)
        share = lens_blur(empty.shell.astype(np.float32), float(np.hypot(lens_blur_px, _EDGE_PX)))[
            self._window
        ]
        self._whole = (share > 0.999).astype(np.uint8)
        self._edge = np.nonzero((share > 0.001) & (share < 0.999))
        self._share = share[self._edge][:, None]
        rng = np.random.default_rng([seed, 0, _FOR_CLOUDS, sensor.FOR_SCENERY])
        self._tiles = _tile(rng), _tile(rng)
        self._phase_rad = rng.uniform(0, 2 * np.pi)
        self._direction = _direction_px(cam, x, y, width, height)
        cloudy = np.linspace(0, 1, 256)[:, None]
        self._light = (_BLUE + contrast * cloudy * (_WHITE - _BLUE)).astype(np.float32)
        self._levels = sensor.develop(self._light[None])

    def draw(self, image: UInt8[np.ndarray, "height width 3"], time_s: float) -> None:
        """Draw the sky of a time over the walls and the ceiling of an empty room."""
        part = image[self._window]
        if not part.size:
            return
        clouds = cv2.resize(self._clouds(time_s), part.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        shown = np.asarray(cv2.LUT(cv2.merge([clouds, clouds, clouds]), self._levels))
        before = part[self._edge]
        cv2.copyTo(shown, self._whole, part)
        if len(before):
            light = sensor.undevelop(before[None])[0]
            mixed = self._share * self._light[clouds[self._edge]] + (1 - self._share) * light
            part[self._edge] = sensor.develop(mixed[None])[0]

    def _clouds(self, time_s: float) -> UInt8[np.ndarray, "rows columns"]:
        """Share of white, in 1/255, at every second pixel of the window."""
        across, up = self._direction
        angle = 2 * np.pi * time_s / _CHANGE_S + self._phase_rad
        # OpenCV's coordinates end at 32767 px.
        drift_px = _TILE_PX / _TILE_RAD * _DRIFT_RAD_S * time_s
        layers = [
            weight
            * cv2.remap(
                tile,
                across - np.float32(speed * drift_px % _TILE_PX),
                up,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_WRAP,
            )
            for tile, speed, weight in zip(
                self._tiles, (1.0, _NEARER), (np.cos(angle), np.sin(angle)), strict=True
            )
        ]
        return np.asarray(cv2.convertScaleAbs(np.clip(layers[0] + layers[1] + 0.5, 0, 1.5), alpha=170))


def _direction_px(
    cam: Pinhole, x: int, y: int, width: int, height: int
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Column and row of the clouds' picture that pixels of a window show."""
    columns, rows = -(-width // _COARSER), -(-height // _COARSER)
    # The middles of the coarser pixels.
    across = x + (np.arange(columns) + 0.5) * (width / max(columns, 1)) - 0.5
    down = y + (np.arange(rows) + 0.5) * (height / max(rows, 1)) - 0.5
    pixels = np.stack([*np.meshgrid(across, down), np.ones((rows, columns))], axis=-1)
    rays = pixels @ (cam.R.T @ np.linalg.inv(cam.K)).T
    scale = _TILE_PX / _TILE_RAD
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    elevation = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
    # Nothing looks along the cut of the azimuth twice: the picture repeats itself there.
    return (scale * azimuth).astype(np.float32), (-scale * elevation).astype(np.float32)


def _tile(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    """Smooth random values of several sizes with mean 0 and standard deviation 1, which go on at the opposite side."""
    values = np.zeros((_TILE_PX, _TILE_PX), np.float32)
    for octave in range(_OCTAVES):
        cells = _CELLS * 2**octave
        pad, scale = 2, _TILE_PX // cells
        coarse = np.pad(rng.standard_normal((cells, cells)).astype(np.float32), pad, mode="wrap")
        fine = cv2.resize(coarse, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        cut = slice(pad * scale, pad * scale + _TILE_PX)
        values += _FAINTER**octave * fine[cut, cut]
    return np.asarray((values - values.mean()) / values.std(), np.float32)

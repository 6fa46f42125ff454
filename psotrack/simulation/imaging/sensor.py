"""The sensor of a camera: gamma, drift of the gains, automatic exposure, flicker of the lamps, noise, JPEG.

The noise is drawn once per camera as a tile that is used with a random offset in each frame, so that a pixel's noise
differs from frame to frame without new random numbers for each pixel. The randomness of a frame depends only on (seed,
stream, frame), and slow changes depend only on (seed, stream, time), so any frame can be drawn alone.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.simulation.scenarios import Imaging

Image = UInt8[np.ndarray, "height width 3"]
Light = Float[np.ndarray, "height width 3"]
GAMMA = 2.2
#: Number of the first on-board camera's random stream; the stream of a static camera is the camera's index.
ONBOARD_STREAM = 1000

#: Number of sinusoids of a slow change, and range of their periods.
_DRIFT_TERMS, _DRIFT_PERIODS_S = 6, (5.0, 60.0)
#: Largest offset of the noise tile.
_TILE_MARGIN_PX = 128
#: Value of one standard deviation in a noise tile.
_TILE_UNIT = 32
#: Mixture of independent noises in the channels, which correlates the channels.
_CHANNEL_MIX = np.array([[0.8, 0.2, 0.1], [0.2, 0.8, 0.2], [0.1, 0.2, 0.8]], np.float32)
#: Last number of each random seed. It is never 0, because NumPy ignores zeros at the end of a seed.
_FOR_TILE, _FOR_FRAME, _FOR_DRIFT, _FOR_MAINS, _FOR_EXPOSURE, FOR_SCENERY = 1, 2, 3, 4, 5, 6

#: Steps of light in the table of grey levels; enough for the darkest grey levels, which cover a small range of light.
_DISPLAY_STEPS = 65536


_DISPLAY = (255 * (np.arange(_DISPLAY_STEPS) / (_DISPLAY_STEPS - 1)) ** (1 / GAMMA)).round().astype(np.uint8)
_LIGHT = ((np.arange(256) / 255) ** GAMMA).astype(np.float32)


def develop(light: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Grey levels of linear light, without noise; light 1 is full scale, and brighter light is clipped."""
    steps = np.clip(light * (_DISPLAY_STEPS - 1) + 0.5, 0, _DISPLAY_STEPS - 1)
    return _DISPLAY[steps.astype(np.uint16)]


def undevelop(image: Image) -> Light:
    """Linear light of grey levels."""
    return cv2.LUT(image, _LIGHT)


def draw_over(part: Image, seen: Float[np.ndarray, "height width 4"]) -> None:
    """Draw over a part of an image, with light and the share of the light from behind that is still seen."""
    part[...] = develop(seen[..., :3] + seen[..., 3:] * undevelop(part))


def flicker_gain(imaging: Imaging, phase_rad: float, time_s: float) -> float:
    """Light of the lamps during one exposure, relative to their mean over time.

    Lamps follow the power of the mains, sin^2(2 pi f t); where the power is 0, their light is lower by the share
    `imaging.flicker`. The mean of 1 - flicker cos^2(...) over the exposure [t - T / 2, t + T / 2] is a cosine of the
    frequency 2 f whose amplitude has the factor sinc(2 f T).

    Args:
        imaging: effects of camera and light; `flicker`, `mains_hz` and `shutter_s` are used.
        phase_rad: phase of the lamps' light at time 0.
        time_s: middle of the exposure.
    """
    lamp_hz = 2 * imaging.mains_hz
    ripple = np.sinc(lamp_hz * imaging.shutter_s) * np.cos(2 * np.pi * lamp_hz * time_s + phase_rad)
    return float(1 - imaging.flicker / 2 * (1 + ripple)) / (1 - imaging.flicker / 2)


def _drift(rng: np.random.Generator, channels: int) -> Callable[[float], Float[np.ndarray, "channels"]]:
    """A smooth random function of time with standard deviation 1 per channel: a sum of sinusoids of equal amplitude."""
    shape = (channels, _DRIFT_TERMS)
    period_s = np.exp(rng.uniform(np.log(_DRIFT_PERIODS_S[0]), np.log(_DRIFT_PERIODS_S[1]), shape))
    angular_rad_s, phase_rad = 2 * np.pi / period_s, rng.uniform(0, 2 * np.pi, shape)
    return lambda time_s: np.sqrt(2 / _DRIFT_TERMS) * np.sin(angular_rad_s * time_s + phase_rad).sum(axis=-1)


class Sensor:
    """One camera's sensor: gains that change with time, noise, JPEG.

    Args:
        imaging: strengths of the effects.
        seed: seed of the simulation.
        stream: number of the camera's random stream: the index of a static camera, or `ONBOARD_STREAM` plus the index
            of the drone.
        shape: height and width of the images, pixels.
    """

    def __init__(self, imaging: Imaging, seed: int, stream: int, shape: tuple[int, int]) -> None:
        self._imaging, self._seed, self._stream, self._shape = imaging, seed, stream, shape
        rng = self._rng(_FOR_DRIFT)
        self._drift, self._white = _drift(rng, 1), _drift(rng, 3)
        self._exposure_rad = float(self._rng(_FOR_EXPOSURE).uniform(0, 2 * np.pi))
        # The lamps are the same for all cameras.
        self._mains_rad = float(np.random.default_rng([seed, 0, 0, _FOR_MAINS]).uniform(0, 2 * np.pi))
        sigma = np.sqrt(imaging.read_noise**2 + imaging.shot_noise**2 * np.arange(256) / 255)
        self._sigma_unit = 127 / max(float(sigma[-1]), 1e-9)
        self._sigma = (sigma * self._sigma_unit).round().astype(np.int8)
        self._tile = _noise_tile(shape, self._rng(_FOR_TILE)) if sigma[-1] else None

    def gains(self, time_s: float) -> Float[np.ndarray, "3"]:
        """(3,), BGR, factors of linear light at a time by drift, automatic exposure and flicker."""
        imaging = self._imaging
        white = self._white(time_s)
        # The common part of the channels is brightness and is removed, which leaves 2/3 of the variance.
        white = np.sqrt(1.5) * (white - white.mean())
        drift = (1 + imaging.exposure_drift * self._drift(time_s)) * (1 + imaging.white_balance_drift * white)
        lamps = flicker_gain(imaging, self._mains_rad, time_s)
        return np.maximum(drift, 0) * lamps * self.exposure(time_s)

    def exposure(self, time_s: float) -> float:
        """Factor of the light by the automatic exposure, which swings between its limits."""
        low, high = np.log(self._imaging.exposure)
        swing = np.sin(2 * np.pi * time_s / self._imaging.exposure_period_s + self._exposure_rad)
        return float(np.exp((low + high) / 2 + (high - low) / 2 * swing))

    def expose(self, image: Image, frame: int, time_s: float) -> Image:
        """Image with the gains at a time, the noise of one frame, and JPEG compression."""
        # A factor g of light is a factor g^(1 / gamma) of grey levels.
        levels = np.arange(256)[:, None] * self.gains(time_s) ** (1 / GAMMA)
        exposed = cv2.LUT(image, np.clip(levels.round(), 0, 255).astype(np.uint8)[None])
        if self._tile is not None:
            y, x = self._rng(_FOR_FRAME, frame).integers(0, _TILE_MARGIN_PX + 1, 2)
            tile = self._tile[y : y + self._shape[0], x : x + self._shape[1]]
            scale = 1 / (self._sigma_unit * _TILE_UNIT)
            noise = cv2.multiply(tile, cv2.LUT(exposed, self._sigma), scale=scale, dtype=cv2.CV_8S)
            exposed = cv2.add(exposed, noise, dtype=cv2.CV_8U)
        if not self._imaging.jpeg_quality:
            return exposed
        _, data = cv2.imencode(".jpg", exposed, [cv2.IMWRITE_JPEG_QUALITY, self._imaging.jpeg_quality])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))

    def _rng(self, purpose: int, frame: int = 0) -> np.random.Generator:
        return np.random.default_rng([self._seed, self._stream, frame, purpose])


def _noise_tile(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    noise = rng.standard_normal((*(extent + _TILE_MARGIN_PX for extent in shape), 3), np.float32)
    # The noise of neighbouring pixels and of channels is correlated, as after demosaicing.
    mixed = cv2.transform(cv2.GaussianBlur(noise, (0, 0), 0.5), _CHANNEL_MIX)
    return np.clip((mixed * (_TILE_UNIT / mixed.std())).round(), -127, 127).astype(np.int8)

"""From light to the numbers of a sensor: gamma, drift of its gains, flicker of the lamps, noise, JPEG.

Noise is drawn once per camera as a tile and shown with another random offset in every frame: a pixel's noise is new
in each frame, and costs no random numbers. What is random in a frame depends on (seed, stream, frame) only, and what
changes slowly on (seed, stream, time), so that any frame can be drawn alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.simulation.scenarios import Imaging

GAMMA = 2.2
#: Streams of random numbers of on-board cameras start here; static cameras have their index.
ONBOARD_STREAM = 1000

#: Slow changes are sums of that many sinusoids, with periods between these.
_DRIFT_TERMS, _DRIFT_PERIODS_S = 6, (5.0, 60.0)
_TILE_MARGIN_PX = 128
#: Noise tiles hold sigma 1 as that number.
_TILE_UNIT = 32
#: How channels share noise.
_CHANNEL_MIX = np.array([[0.8, 0.2, 0.1], [0.2, 0.8, 0.2], [0.1, 0.2, 0.8]], np.float32)
#: What random numbers are for. Never 0: NumPy takes a seed that ends in zeros for one without them.
_FOR_TILE, _FOR_FRAME, _FOR_DRIFT, _FOR_MAINS = 1, 2, 3, 4

#: Fine enough for the darkest levels, which gamma makes narrow in light.
_DISPLAY_STEPS = 65536


def _display_table() -> UInt8[np.ndarray, "steps"]:
    light = np.arange(_DISPLAY_STEPS) / (_DISPLAY_STEPS - 1)
    return (255 * light ** (1 / GAMMA)).round().astype(np.uint8)


_DISPLAY = _display_table()
_LIGHT = ((np.arange(256) / 255) ** GAMMA).astype(np.float32)


def develop(light: Float[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """Grey levels of linear light, without noise: 1 is full scale, and what is brighter is cut off."""
    steps = np.clip(light * (_DISPLAY_STEPS - 1) + 0.5, 0, _DISPLAY_STEPS - 1)
    return _DISPLAY[steps.astype(np.uint16)]


def undevelop(image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    """Linear light of grey levels."""
    return cv2.LUT(image, _LIGHT)


def flicker_gain(imaging: Imaging, phase_rad: float, time_s: float) -> float:
    """Light of the lamps during one exposure, relative to their mean over time.

    Lamps follow the power of the mains, sin^2(2 pi f t), and dim by `imaging.flicker` where it is 0. The mean of
    1 - flicker cos^2(...) over the exposure [t - T / 2, t + T / 2] is a cosine at 2 f, sinc(2 f T) of it left.

    Args:
        imaging: its `flicker`, `mains_hz` and `shutter_s`.
        phase_rad: of the lamps' light at time 0.
        time_s: the exposure's middle.
    """
    lamp_hz = 2 * imaging.mains_hz
    ripple = np.sinc(lamp_hz * imaging.shutter_s) * np.cos(2 * np.pi * lamp_hz * time_s + phase_rad)
    return float(1 - imaging.flicker / 2 * (1 + ripple)) / (1 - imaging.flicker / 2)


@dataclass(frozen=True)
class _Drift:
    """A smooth random course over time, of standard deviation 1: sinusoids of one amplitude, per channel."""

    angular_rad_s: Float[np.ndarray, "channels terms"]
    phase_rad: Float[np.ndarray, "channels terms"]

    def at(self, time_s: float) -> Float[np.ndarray, "channels"]:
        terms = np.sin(self.angular_rad_s * time_s + self.phase_rad)
        return np.sqrt(2 / _DRIFT_TERMS) * terms.sum(axis=-1)


def _drift(rng: np.random.Generator, channels: int) -> _Drift:
    shape = (channels, _DRIFT_TERMS)
    period_s = np.exp(rng.uniform(np.log(_DRIFT_PERIODS_S[0]), np.log(_DRIFT_PERIODS_S[1]), shape))
    return _Drift(2 * np.pi / period_s, rng.uniform(0, 2 * np.pi, shape))


class Sensor:
    """One camera's sensor: gains that change with time, noise, JPEG.

    Args:
        imaging: which of these, and how strong.
        seed: of the simulation.
        stream: other cameras have other noise; static ones have their index, on-board ones start at
            `ONBOARD_STREAM`.
        shape: (height, width).
    """

    def __init__(self, imaging: Imaging, seed: int, stream: int, shape: tuple[int, int]) -> None:
        self._imaging, self._seed, self._stream, self._shape = imaging, seed, stream, shape
        rng = self._rng(_FOR_DRIFT)
        self._exposure, self._white = _drift(rng, 1), _drift(rng, 3)
        # The lamps are the same for all cameras.
        self._mains_rad = float(np.random.default_rng([seed, 0, 0, _FOR_MAINS]).uniform(0, 2 * np.pi))
        sigma = np.sqrt(imaging.read_noise**2 + imaging.shot_noise**2 * np.arange(256) / 255)
        self._sigma_unit = 127 / max(float(sigma[-1]), 1e-9)
        self._sigma = (sigma * self._sigma_unit).round().astype(np.int8)
        self._tile = _noise_tile(shape, self._rng(_FOR_TILE)) if sigma[-1] else None

    def gains(self, time_s: float) -> Float[np.ndarray, "3"]:
        """(3,), BGR: linear light at a time, relative to what it would be without drift and flicker."""
        imaging = self._imaging
        white = self._white.at(time_s)
        # Colours against one another: what they share is brightness. Without it 2/3 of the variance is left.
        white = np.sqrt(1.5) * (white - white.mean())
        drift = (1 + imaging.exposure_drift * self._exposure.at(time_s)) * (
            1 + imaging.white_balance_drift * white
        )
        return np.maximum(drift, 0) * flicker_gain(imaging, self._mains_rad, time_s)

    def expose(
        self, image: UInt8[np.ndarray, "height width 3"], frame: int, time_s: float
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The image with the gains of a time, the noise of one frame, and what JPEG leaves of it."""
        # Light times g is grey levels times g^(1 / gamma).
        levels = np.arange(256)[:, None] * self.gains(time_s) ** (1 / GAMMA)
        exposed = cv2.LUT(image, np.clip(levels.round(), 0, 255).astype(np.uint8)[None])
        if self._tile is not None:
            y, x = self._rng(_FOR_FRAME, frame).integers(0, _TILE_MARGIN_PX + 1, 2)
            tile = self._tile[y : y + self._shape[0], x : x + self._shape[1]]
            scale = 1 / (self._sigma_unit * _TILE_UNIT)
            noise = cv2.multiply(tile, cv2.LUT(exposed, self._sigma), scale=scale, dtype=cv2.CV_8S)
            exposed = cv2.add(exposed, noise, dtype=cv2.CV_8U)
        return _through_jpeg(exposed, self._imaging.jpeg_quality) if self._imaging.jpeg_quality else exposed

    def _rng(self, purpose: int, frame: int = 0) -> np.random.Generator:
        return np.random.default_rng([self._seed, self._stream, frame, purpose])


def _noise_tile(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    noise = rng.standard_normal((*(extent + _TILE_MARGIN_PX for extent in shape), 3), np.float32)
    # Neighbours share noise, as demosaicing makes them, and so do channels.
    mixed = cv2.transform(cv2.GaussianBlur(noise, (0, 0), 0.5), _CHANNEL_MIX)
    return np.clip((mixed * (_TILE_UNIT / mixed.std())).round(), -127, 127).astype(np.int8)


def _through_jpeg(
    image: UInt8[np.ndarray, "height width 3"], quality: int
) -> UInt8[np.ndarray, "height width 3"]:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))

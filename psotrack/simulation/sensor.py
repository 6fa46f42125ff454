"""From light to the numbers of a sensor: gamma, flicker of the lamps, shot and read noise.

Noise is drawn once per camera as a tile and shown with another random offset in every frame: a pixel's noise is new
in each frame, and costs no random numbers. What is random in a frame depends on (seed, camera, frame) only.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

GAMMA = 2.2
#: Light 1 (white in the middle of the floor) is shown as that share of full scale.
_EXPOSURE = 1.0
#: Standard deviation of noise in grey levels at black, and at full scale.
_READ_SIGMA, _SHOT_SIGMA = 1.0, 3.0
#: Lamps brighten and dim by that share, and by as much again at random.
_FLICKER, _FLICKER_RANDOM = 0.006, 0.002
#: What is left of the mains' frequency after sampling at the frame rate.
_FLICKER_HZ = 1.7
_TILE_MARGIN_PX = 128
#: Noise tiles hold sigma 1 as that number.
_TILE_UNIT = 32

#: How channels share noise.
_CHANNEL_MIX = np.array([[0.8, 0.2, 0.1], [0.2, 0.8, 0.2], [0.1, 0.2, 0.8]], np.float32)

_DISPLAY_STEPS = 4096


def _display_table() -> UInt8[np.ndarray, "steps"]:
    light = np.arange(_DISPLAY_STEPS) / (_DISPLAY_STEPS - 1)
    return (255 * light ** (1 / GAMMA)).round().astype(np.uint8)


_DISPLAY = _display_table()
_LIGHT = ((np.arange(256) / 255) ** GAMMA / _EXPOSURE).astype(np.float32)


def develop(light: Float[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """Grey levels of linear light, without noise; what is brighter than full scale is cut off."""
    steps = np.clip(light * (_EXPOSURE * (_DISPLAY_STEPS - 1)) + 0.5, 0, _DISPLAY_STEPS - 1)
    return _DISPLAY[steps.astype(np.uint16)]


def undevelop(image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    """Linear light of grey levels."""
    return cv2.LUT(image, _LIGHT)


class Sensor:
    """The noise of one camera.

    Args:
        seed: of the simulation.
        camera_index: other cameras have other noise.
        shape: (height, width).
    """

    def __init__(self, seed: int, camera_index: int, shape: tuple[int, int]) -> None:
        self._seed, self._camera_index, self._shape = seed, camera_index, shape
        rng = np.random.default_rng([seed, camera_index])
        side = [extent + _TILE_MARGIN_PX for extent in shape]
        noise = rng.standard_normal((*side, 3), np.float32)
        # Neighbours share noise, as demosaicing makes them, and so do channels.
        mixed = cv2.transform(cv2.GaussianBlur(noise, (0, 0), 0.5), _CHANNEL_MIX)
        self._tile = np.clip((mixed * (_TILE_UNIT / mixed.std())).round(), -127, 127).astype(np.int8)
        # Shot noise is the root of light; gamma turns that into a slow rise that is steepest near black.
        level = np.arange(256) / 255
        sigma = np.sqrt(_READ_SIGMA**2 + (_SHOT_SIGMA**2 - _READ_SIGMA**2) * level)
        self._sigma = (sigma * 16).round().astype(np.int8)

    def expose(
        self, image: UInt8[np.ndarray, "height width 3"], frame: int, time_s: float
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The image with the flicker and the noise of one frame."""
        rng = np.random.default_rng([self._seed, self._camera_index, frame])
        y, x = rng.integers(0, _TILE_MARGIN_PX + 1, 2)
        tile = self._tile[y : y + self._shape[0], x : x + self._shape[1]]
        gain = (
            1 + _FLICKER * np.sin(2 * np.pi * _FLICKER_HZ * time_s) + _FLICKER_RANDOM * rng.standard_normal()
        )
        levels = np.clip((np.arange(256) * gain).round(), 0, 255).astype(np.uint8)
        noise = cv2.multiply(tile, cv2.LUT(image, self._sigma), scale=1 / (16 * _TILE_UNIT), dtype=cv2.CV_8S)
        return cv2.add(cv2.LUT(image, levels), noise, dtype=cv2.CV_8U)

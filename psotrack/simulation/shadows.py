"""Shadows of drones on the floor: soft, one for each lamp."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from psotrack.simulation.drones import DroneModel, disc_fans
from psotrack.simulation.raster import Pinhole
from psotrack.simulation.scene import Scene
from psotrack.simulation.sensor import GAMMA

_CELL_M = 0.04
#: Cells of a drone's outline.
_FINE_M = 0.01
#: How much light a rotor disc takes away.
_DISC_SHARE = 0.25


class FloorShadows:
    """Casts the drones' shadows on the floor of one camera's image.

    Lamps are equally high and the floor is flat, so a drone's footprint is the same under each of them: its outline
    from above, magnified, blurred by the panel's size, and moved. Where shadows fall is kept as a map of the floor.
    """

    def __init__(self, scene: Scene, cam: Pinhole, floor: Bool[np.ndarray, "height width"]) -> None:
        self._scene = scene
        self._outlines = [_outline(shape) for shape in scene.models]
        ground = scene.room.surfaces[0]
        self._corner_m = ground.corner_m
        extent = [float(np.linalg.norm(ground.along_m)), float(np.linalg.norm(ground.down_m))]
        self._shape = (round(extent[1] / _CELL_M), round(extent[0] / _CELL_M))
        # Cell (column, row) to the floor's point, then to the image; the floor is z = 0.
        along, down = ground.along_m / self._shape[1], ground.down_m / self._shape[0]
        cell_to_world = np.column_stack([along, down, ground.corner_m + 0.5 * (along + down)])
        H = cam.K @ (cam.R @ cell_to_world + np.outer(cam.t_m, [0, 0, 1]))
        x, y, width, height = cv2.boundingRect(floor.astype(np.uint8))
        self._window = (slice(y, y + height), slice(x, x + width))
        self._H = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]]) @ H
        self._not_floor = np.where(floor[self._window], 0, 255).astype(np.uint8)

    def cast(self, image: UInt8[np.ndarray, "height width 3"], time_s: float) -> None:
        """Darken the floor in the image."""
        gain = self.floor_gain(time_s)
        part = image[self._window]
        if not part.size:
            return
        shown = cv2.warpPerspective(
            (255 * gain ** (1 / GAMMA)).round().astype(np.uint8),
            self._H,
            part.shape[1::-1],
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=255,
        )
        shown = cv2.max(shown, self._not_floor)
        x, y, width, height = cv2.boundingRect(255 - shown)
        if width:
            part = part[y : y + height, x : x + width]
            shown = shown[y : y + height, x : x + width]
            cv2.multiply(part, cv2.merge([shown, shown, shown]), dst=part, scale=1 / 255)

    def floor_gain(self, time_s: float) -> Float[np.ndarray, "rows columns"]:
        """(rows, columns), the share of light that still reaches each cell of the floor."""
        gain = np.ones(self._shape, np.float32)
        panels = self._scene.room.panels
        time = np.array([time_s])
        up = np.array([[0.0, 0.0, 1.0]])
        for flight, outline in zip(self._scene.flights, self._outlines, strict=True):
            position = flight.position_m(time)[0]
            lamp_height = float(panels.centres_m[0, 2])
            magnified = lamp_height / (lamp_height - position[2])
            # A panel of length s casts an edge s (m - 1) wide: a box, whose standard deviation is a 1 / sqrt(12) of it.
            sigmas_m = [max(side * (magnified - 1) / np.sqrt(12), _CELL_M) for side in panels.size_m]
            patch = _soft(outline, flight.rotation(time)[0, :2, :2], magnified, sigmas_m)
            for lamp in panels.centres_m:
                fall = lamp + (position - lamp) * magnified
                weight = panels.direct(fall[None], up, lamp)[0] / panels.on_faces(fall, up)[0]
                self._stamp(gain, weight * patch, fall)
        return gain

    def _stamp(
        self, gain: Float[np.ndarray, "rows columns"], patch: Float[np.ndarray, "side side"], at_m: np.ndarray
    ) -> None:
        """Take the patch's share of light away around a point of the floor."""
        centre = np.array([at_m[0] - self._corner_m[0], self._corner_m[1] - at_m[1]]) / _CELL_M - 0.5
        first = np.floor(centre).astype(int) - len(patch) // 2
        part = centre - np.floor(centre)
        moved = cv2.warpAffine(patch, np.array([[1, 0, part[0]], [0, 1, part[1]]]), patch.shape[::-1])
        low, high = np.maximum(first, 0), np.minimum(first + len(patch), gain.shape[::-1])
        if np.all(high > low):
            (x1, y1), (x2, y2) = low - first, high - first
            gain[low[1] : high[1], low[0] : high[0]] *= 1 - moved[y1:y2, x1:x2]


def _outline(shape: DroneModel) -> Float[np.ndarray, "side side"]:
    """(side, side), the share of light that a drone takes, from above, body x to the right and y up, fine cells."""
    half = int(np.ceil(shape.radius_m / _FINE_M)) + 1
    outline = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for triangles, share in ((disc_fans(shape), _DISC_SHARE), (shape.triangles_m, 1.0)):
        corners = np.round(triangles[..., :2] * [1, -1] / _FINE_M + half).astype(np.int32)
        for triangle in corners:
            cv2.fillConvexPoly(outline, triangle, share)
    return outline


def _soft(
    outline: Float[np.ndarray, "side side"],
    turn: Float[np.ndarray, "2 2"],
    magnified: float,
    sigmas_m: list[float],
) -> Float[np.ndarray, "cells cells"]:
    """(cells, cells), the outline turned, magnified and blurred, in cells of the floor; its middle in the middle."""
    half = int(len(outline) * _FINE_M * magnified / 2 / _CELL_M + 3 * max(sigmas_m) / _CELL_M) + 2
    # Rows count down where y counts up: a turn in the plane is its transpose in the image.
    A = magnified * _FINE_M / _CELL_M * np.array([[turn[0, 0], -turn[0, 1]], [-turn[1, 0], turn[1, 1]]])
    offset = half - A @ np.full(2, len(outline) // 2)
    small = cv2.GaussianBlur(outline, (0, 0), _CELL_M / _FINE_M / 2 / magnified)
    patch = cv2.warpAffine(small, np.column_stack([A, offset]), (2 * half + 1, 2 * half + 1))
    return cv2.GaussianBlur(patch, (0, 0), sigmas_m[0] / _CELL_M, sigmaY=sigmas_m[1] / _CELL_M)

"""Frames: the backdrop with drones, their rotors and their shadows drawn into it, then the sensor.

Only a window around each drone is drawn, `NUM_PASSES` times, each pass with its samples elsewhere in the pixel and
at another time of the exposure: edges without stairs and motion blur in one.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.simulation import backdrop, sensor
from psotrack.simulation.backdrop import LENS_SIGMA_PX, Backdrop
from psotrack.simulation.posing import PosedDrone, pose
from psotrack.simulation.raster import Pinhole, View, draw, empty_buffers, enclosing, full_view, pinhole
from psotrack.simulation.scene import Scene
from psotrack.simulation.shadows import FloorShadows

NUM_PASSES = 8
#: Pixels kept around what is drawn, for the lens's blur and motion.
_MARGIN_PX = 4

Image = UInt8[np.ndarray, "height width 3"]


class CameraRenderer:
    """Draws the frames of one camera of a scene; holds what stays the same between them."""

    def __init__(self, scene: Scene, camera_index: int) -> None:
        self.scene = scene
        self.camera_index = camera_index
        self.cam: Pinhole = pinhole(scene.rig.cameras[camera_index])
        self.backdrop: Backdrop = backdrop.render(scene.room, self.cam)
        self.sensor = sensor.Sensor(scene.seed, camera_index, self.backdrop.light.shape[:2])
        self._clean: Image = sensor.develop(self.backdrop.light)
        self.shadows = FloorShadows(scene, self.cam, self.backdrop.floor)

    def clean_frame(self, frame: int) -> Image:
        """The frame without noise and flicker: BGR, (height, width, 3)."""
        image = self._clean.copy()
        time_s = self.scene.time_s(frame)
        self.shadows.cast(image, time_s)
        during_s = time_s + _SAMPLES[:, 2] * self.scene.scenario.shutter_s
        posed = [pose(self.scene, drone, during_s) for drone in range(len(self.scene.flights))]
        for window, drones in _windows(full_view(self.cam), posed):
            self._draw_drones(image, window, drones)
        return image

    def frame(self, frame: int) -> Image:
        """The frame as the sensor yields it, before the codec: BGR, (height, width, 3)."""
        return self.sensor.expose(self.clean_frame(frame), frame, self.scene.time_s(frame))

    def drone_mask(self, frame: int) -> UInt8[np.ndarray, "height width"]:
        """Which drone is seen in a pixel in the middle of the exposure: its number from 1, or 0; rotors count."""
        view = full_view(self.cam)
        number, depth = empty_buffers(view)
        np.copyto(depth, self.backdrop.depth_m)
        for drone in range(len(self.scene.flights)):
            posed = pose(self.scene, drone, np.array([self.scene.time_s(frame)]))
            triangles = np.concatenate([posed.faces_m[0], posed.discs_m[0]])
            draw(view, triangles, np.full((len(triangles), 1, 3), drone + 1.0), number, depth)
        return number[..., 0].round().astype(np.uint8)

    def _draw_drones(self, image: Image, window: View, drones: list[PosedDrone]) -> None:
        behind_m = self.backdrop.depth_m[window.slices]
        light, clear = np.zeros((*window.shape, 3), np.float32), np.zeros(window.shape, np.float32)
        for index, (x, y, _) in enumerate(_SAMPLES):
            sample, transparency = self._sample(replace(window, shift_px=(x, y)), drones, index, behind_m)
            light += sample
            clear += transparency
        blurred = cv2.GaussianBlur(np.dstack([light, clear]) / NUM_PASSES, (0, 0), LENS_SIGMA_PX)
        part = image[window.slices]
        part[...] = sensor.develop(blurred[..., :3] + blurred[..., 3:] * sensor.undevelop(part))

    def _sample(
        self, view: View, posed: list[PosedDrone], index: int, behind_m: Float[np.ndarray, "rows columns"]
    ) -> tuple[Float[np.ndarray, "rows columns 3"], Float[np.ndarray, "rows columns"]]:
        """Light of drones, and how much of the backdrop is seen through them, one sample per pixel."""
        light, depth = np.full((*view.shape, 3), -1.0, np.float32), behind_m.copy()
        for drone in posed:
            draw(view, drone.faces_m[index], drone.light, light, depth)
        # Where nothing is drawn is told by the colour: OpenCV rounds even those depths that it leaves alone.
        clear = np.less(light[..., 0], 0).astype(np.float32)
        light += clear[..., None]
        # Discs let light through: from the farthest to the nearest, each before what lies behind it.
        ahead = self.cam.R[2]
        for drone in sorted(posed, key=lambda drone: -float(ahead @ drone.discs_m[index, 0, 0])):
            inner = enclosing(view, drone.discs_m[index].reshape(-1, 3), 1)
            if inner is None:
                continue
            part = inner.slices_in(view)
            disc, _ = empty_buffers(inner)
            draw(inner, drone.discs_m[index], drone.disc_opacity_light, disc, depth[part].copy())
            through = 1 - disc[..., 0]
            light[part] *= through[..., None]
            light[part] += (disc[..., 0] * disc[..., 1])[..., None]
            clear[part] *= through
        return light, clear


def _windows(whole: View, posed: list[PosedDrone]) -> list[tuple[View, list[PosedDrone]]]:
    """Parts of the image that hold drones, those that overlap made one, with the drones in each."""
    windows: list[tuple[View, list[PosedDrone]]] = []
    for drone in posed:
        # What moves evenly is widest at the exposure's ends.
        ends = [points[[0, -1]].reshape(-1, 3) for points in (drone.faces_m, drone.discs_m)]
        window, drones = enclosing(whole, np.concatenate(ends), _MARGIN_PX), [drone]
        if window is None:
            continue
        while (
            index := next((i for i, (other, _) in enumerate(windows) if window.overlaps(other)), None)
        ) is not None:
            other, others = windows.pop(index)
            window, drones = window.joined(other), others + drones
        windows.append((window, drones))
    return windows


def _pass_samples(num_passes: int) -> Float[np.ndarray, "passes 3"]:
    """(passes, 3): x, y and time, each in -1/2..1/2, evenly spread: Hammersley points of bases 2 and 3."""

    def radical_inverse(number: int, base: int) -> float:
        value, weight = 0.0, 1.0 / base
        while number:
            value += weight * (number % base)
            number, weight = number // base, weight / base
        return value

    points = np.array(
        [(radical_inverse(i, 2), radical_inverse(i, 3), (i + 0.5) / num_passes) for i in range(num_passes)]
    )
    # Their mean is the pixel's centre and the exposure's middle, so nothing shifts.
    return points - points.mean(axis=0)


_SAMPLES = _pass_samples(NUM_PASSES)

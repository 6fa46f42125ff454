"""Frames of static cameras: shadows, mirror images, scenery and drones over the backdrop, then lamp and sensor.

Only windows around drones, their mirror images and changing scenery are drawn in each frame. A lens with distortion is
drawn as one or more views without distortion, from which its image is put together before the sensor is applied.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.simulation.imaging import backdrop, reflections, sensor
from psotrack.simulation.imaging.backdrop import Backdrop, lens_blur
from psotrack.simulation.imaging.lens_image import LensImage, lens_image
from psotrack.simulation.imaging.posing import PosedDrone, average, margin_px, pass_samples, pose, windows
from psotrack.simulation.imaging.raster import Pinhole, RasterView, full_view, pinhole
from psotrack.simulation.imaging.reflections import Mirror
from psotrack.simulation.imaging.scenery import Scenery
from psotrack.simulation.imaging.shadows import FloorShadows
from psotrack.simulation.scene import Scene

Image = UInt8[np.ndarray, "height width 3"]


class CameraRenderer:
    """Draws the frames of one static camera of a scene; the parts that all frames share are drawn once.

    Args:
        scene: the scene.
        camera_index: index of the camera.
        stream: number of the camera's random stream; None: its index.

    Attributes:
        scene: the scene.
        cam: the camera without its distortion.
        size_wh: width and height of the images, pixels.
        lens: how the image is put together from several views; None for a lens without distortion.
        views: views without distortion; for a lens without distortion the only view is the image.
        backdrop, mirror, shadows: parts of the first view.
        scenery: what changes behind the drones.
        sensor: the sensor.
    """

    def __init__(self, scene: Scene, camera_index: int, stream: int | None = None) -> None:
        imaging, camera = scene.scenario.imaging, scene.rig.cameras[camera_index]
        self.scene = scene
        self.cam: Pinhole = pinhole(camera)
        self.size_wh = self.cam.width, self.cam.height
        is_fisheye = camera.fisheye is not None and bool(camera.fisheye)
        self.lens: LensImage | None = lens_image(camera) if is_fisheye or camera.dist.any() else None
        stream, shape = camera_index if stream is None else stream, (self.cam.height, self.cam.width)
        self.scenery = Scenery(scene.scenario.surroundings, scene.seed, stream, shape, imaging.lens_blur_px)
        if self.lens is None:
            self.views = [View(scene, self.cam, self.scenery)]
        else:
            faces = zip(self.lens.faces, self.lens.shows_px, strict=True)
            self.views = [View(scene, cam, self.scenery, shows_px) for cam, shows_px in faces]
        self.backdrop, self.mirror = self.views[0].backdrop, self.views[0].mirror
        self.shadows = self.views[0].shadows
        self.sensor = sensor.Sensor(imaging, scene.seed, stream, shape)

    def clean_frame(self, frame: int) -> Image:
        """(height, width, 3), BGR image of a frame without the effects of the sensor."""
        image = self.assemble([view.clean_frame(frame) for view in self.views])
        self.scenery.light(image, self.scene.time_s(frame))
        return image

    def empty_room(self) -> Image:
        """(height, width, 3), BGR image of the room without drones and without the effects of the sensor."""
        return self.assemble([view.empty_room() for view in self.views])

    def assemble(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> Image:
        """(height, width, 3), the image of the camera, from the images of its views; their sizes may differ."""
        return images[0] if self.lens is None else self.lens.assemble(images)

    def frame(self, frame: int) -> Image:
        """(height, width, 3), BGR image of a frame from the sensor, before the codec."""
        return self.sensor.expose(self.clean_frame(frame), frame, self.scene.time_s(frame))


class View:
    """Draws the frames of one camera without distortion, without the effects of lamp and sensor.

    Args:
        scene: the scene.
        cam: the camera.
        behind: what changes behind the drones, in the image of the lens.
        shows_px: (height, width, 2), column and row of the lens's image that each pixel shows; None: the same image.
    """

    def __init__(
        self,
        scene: Scene,
        cam: Pinhole,
        behind: Scenery,
        shows_px: Float[np.ndarray, "height width 2"] | None = None,
    ) -> None:
        imaging = scene.scenario.imaging
        self.scene = scene
        self.cam = cam
        self.backdrop: Backdrop = backdrop.render(scene.room, self.cam, imaging)
        self.mirror: Mirror | None = None
        if imaging.reflections:
            self.mirror = reflections.mirror(scene.room, self.cam, imaging, self.backdrop)
            self.backdrop = self.mirror.on(self.backdrop)
        self.shadows = FloorShadows(scene, self.cam, self.backdrop, self.mirror)
        self._clean: Image = sensor.develop(self.backdrop.light)
        self._samples = pass_samples(imaging)
        self._behind, self._shows_px = behind, shows_px

    def clean_frame(self, frame: int) -> Image:
        """(height, width, 3), BGR image of a frame without the effects of the sensor."""
        image = self._clean.copy()
        imaging = self.scene.scenario.imaging
        time_s = self.scene.time_s(frame)
        self.shadows.cast(image, time_s)
        during_s = time_s + self._samples[:, 2] * imaging.shutter_s
        posed = [pose(self.scene, drone, during_s) for drone in range(len(self.scene.flights))]
        if self.mirror is not None:
            self.mirror.reflect(image, posed, self._samples, imaging.lens_blur_px)
        for layer in self._behind.layers(time_s):
            shown = layer if self._shows_px is None else layer.moved(self._shows_px)
            if shown is not None:
                shown.draw(image)
        for window, drones in windows(full_view(self.cam), posed, margin_px(imaging.lens_blur_px)):
            self._draw_drones(image, window, drones)
        return image

    def empty_room(self) -> Image:
        """(height, width, 3), BGR image of the room without drones."""
        return self._clean.copy()

    def _draw_drones(self, image: Image, window: RasterView, drones: list[PosedDrone]) -> None:
        seen = average(window, drones, self._samples, self.backdrop.depth_m[window.slices])
        seen = lens_blur(seen, self.scene.scenario.imaging.lens_blur_px)
        part = image[window.slices]
        part[...] = sensor.develop(seen[..., :3] + seen[..., 3:] * sensor.undevelop(part))

"""Frames of static cameras and of cameras on drones.

Of a static camera, only windows around drones, their mirror images and changing scenery are drawn in each frame over
the backdrop, then lamp and sensor are applied. A lens with distortion is drawn as one or more views without
distortion, from which its image is put together before the sensor is applied.

On-board cameras are action cameras, fixed to the drone's body, that see the room and the other drones. Each frame is
the mean of several drawings with different sample positions in the pixel and different times in the exposure, which
gives anti-aliasing and motion blur together. The drone that carries the camera is not drawn, because a camera at its
nose does not see it; its shadow is drawn. Reflections of the floor are not drawn.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import cv2
import msgspec
import numpy as np
from jaxtyping import Float, UInt8, UInt16
from scipy.spatial.transform import Rotation

from psotrack.geometry import Camera, make_camera
from psotrack.simulation.flights.motion import quaternions_wxyz
from psotrack.simulation.flights.planning import frame_times_s
from psotrack.simulation.imaging import backdrop, raster, sensor
from psotrack.simulation.imaging.floor import FloorLight, FloorShadows, Mirror, mirror
from psotrack.simulation.imaging.lens_image import LensImage, Strip, lens_image, show_strip, strips
from psotrack.simulation.imaging.scenery import Scenery
from psotrack.simulation.imaging.sensor import Image
from psotrack.simulation.labels import Silhouette, lens_silhouettes, silhouettes
from psotrack.simulation.scenarios import OnboardCamera
from psotrack.simulation.scene import Scene, image_size_wh
from psotrack.simulation.world.rooms import room

_Part = UInt8[np.ndarray, "_ _ 3"]
#: Smallest and largest number of samples per pixel, and motion blur per sample, pixels. The smallest number is enough
#: for anti-aliasing. With 0.6 px per sample, corners of markers were found up to 0.1 px off in the same direction.
_MIN_SAMPLES, _MAX_SAMPLES, _BLUR_PER_SAMPLE_PX = 4, 24, 0.35
#: Smallest distance at which the number of samples gives smooth motion blur; nearer objects may show steps.
_NEAR_SCENERY_M = 1.5
#: Additive recurrence of the plastic number, which spreads any number of points evenly over a square (Roberts, "The
#: unreasonable effectiveness of quasirandom sequences", 2018).
_RECURRENCE = np.array([0.7548776662466927, 0.5698402909980532])
#: Grey level of each light in units of 1 / `LIGHT_UNIT`.
_DISPLAY = sensor.develop(np.arange(1 << 16) / backdrop.LIGHT_UNIT)


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
        scenery: what changes behind the drones.
        sensor: the sensor.
    """

    def __init__(self, scene: Scene, camera_index: int, stream: int | None = None) -> None:
        imaging, camera = scene.scenario.imaging, scene.rig.cameras[camera_index]
        self.scene = scene
        self.cam: raster.Pinhole = raster.pinhole(camera)
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
        self.sensor = sensor.Sensor(imaging, scene.seed, stream, shape)

    def clean_frame(self, frame: int) -> Image:
        """(height, width, 3), BGR image of a frame without the effects of the sensor."""
        image = self.assemble([view.clean_frame(frame) for view in self.views])
        self.scenery.light(image, self.scene.time_s(frame))
        return image

    def assemble(self, images: Sequence[_Part]) -> Image:
        """(height, width, 3), the image of the camera, from the images of its views; their sizes may differ."""
        return images[0] if self.lens is None else self.lens.assemble(images)

    def frame(self, frame: int) -> Image:
        """(height, width, 3), BGR image of a frame from the sensor, before the codec."""
        return self.sensor.expose(self.clean_frame(frame), frame, self.scene.time_s(frame))

    def silhouettes(self, frame: int) -> list[Silhouette]:
        """Silhouettes of the drones within the image of a frame, ordered by number."""
        depths_m = [view.backdrop.depth_m for view in self.views]
        if self.lens is None:
            return silhouettes(self.scene, self.cam, depths_m[0], frame)
        return lens_silhouettes(self.scene, self.cam, self.lens, depths_m, frame)


class View:
    """Draws the frames of one camera without distortion, without the effects of lamp and sensor.

    Args:
        scene: the scene.
        cam: the camera.
        behind: what changes behind the drones, in the image of the lens.
        shows_px: (height, width, 2), column and row of the lens's image that each pixel shows; None: the same image.

    Attributes:
        empty_room: (height, width, 3), BGR image of the room without drones.
    """

    def __init__(
        self,
        scene: Scene,
        cam: raster.Pinhole,
        behind: Scenery,
        shows_px: Float[np.ndarray, "height width 2"] | None = None,
    ) -> None:
        imaging = scene.scenario.imaging
        self.scene = scene
        self.cam = cam
        self.backdrop: backdrop.Backdrop = backdrop.render(scene.room, self.cam, imaging)
        self.mirror: Mirror | None = None
        if imaging.reflections:
            self.mirror = mirror(scene.room, self.cam, imaging, self.backdrop)
            self.backdrop = self.mirror.on(self.backdrop)
        self.shadows = FloorShadows(scene, self.cam, self.backdrop, self.mirror)
        self.empty_room: Image = sensor.develop(self.backdrop.light)
        self._samples = raster.pass_samples(imaging)
        self._behind, self._shows_px = behind, shows_px

    def clean_frame(self, frame: int) -> Image:
        """(height, width, 3), BGR image of a frame without the effects of the sensor."""
        image = self.empty_room.copy()
        imaging = self.scene.scenario.imaging
        time_s = self.scene.time_s(frame)
        self.shadows.cast(image, time_s)
        during_s = time_s + self._samples[:, 2] * imaging.shutter_s
        posed = [raster.pose(self.scene, drone, during_s) for drone in range(len(self.scene.flights))]
        if self.mirror is not None:
            self.mirror.reflect(image, posed, self._samples, imaging.lens_blur_px)
        for layer in self._behind.layers(time_s):
            shown = layer if self._shows_px is None else layer.moved(self._shows_px)
            if shown is not None:
                shown.draw(image)
        blur_px, whole = imaging.lens_blur_px, raster.full_view(self.cam)
        for window, drones in raster.windows(whole, posed, raster.margin_px(blur_px)):
            seen = raster.average(window, drones, self._samples, self.backdrop.depth_m[window.slices])
            sensor.draw_over(image[window.slices], backdrop.lens_blur(seen, blur_px))
        return image


class OnboardRenderer:
    """Draws the frames of the camera on one drone of a scene."""

    def __init__(self, scene: Scene, drone_index: int) -> None:
        self.scene = scene
        self.drone_index = drone_index
        self.onboard = camera_record(scene)
        self.K, self.size_wh = intrinsics(scene)
        self.width, self.height = self.size_wh
        imaging = msgspec.structs.replace(
            scene.scenario.imaging,
            shutter_s=self.onboard.shutter_s,
            exposure=self.onboard.exposure,
            exposure_period_s=self.onboard.exposure_period_s,
        )
        stream = sensor.ONBOARD_STREAM + drone_index
        self.sensor = sensor.Sensor(imaging, scene.seed, stream, (self.height, self.width))
        camera = lens(scene)
        self._lens: LensImage | None = lens_image(camera) if camera.dist.any() else None
        self._imaging = imaging
        self._floor = FloorLight(scene)
        self._painter = _room_painter(scene.scenario.hall, scene.scenario.markers, scene.scale)

    def cam_at(self, time_s: float) -> raster.Pinhole:
        """Camera at a given time."""
        (centre_m,), (to_world,) = _poses(self.scene, self.drone_index, np.array([time_s]))
        return raster.Pinhole(to_world.T, -to_world.T @ centre_m, self.K, self.width, self.height)

    def frame(self, frame: int) -> Image:
        """(height, width, 3), BGR image of a frame from the sensor, before the codec."""
        return self.sensor.expose(self.clean_frame(frame), frame, self.scene.time_s(frame))

    def clean_frame(self, frame: int) -> Image:
        """(height, width, 3), BGR image of a frame without the effects of the sensor."""
        time_s = self.scene.time_s(frame)
        samples = self._samples(time_s)
        row_px = self._row_motion_px(time_s)
        total = np.zeros((self.height, self.width, 4), np.float32)
        for index, drawn in enumerate(samples):
            for strip in strips(self.height, row_px, index, len(samples)):
                during_s = self._row_time_s(time_s, strip.middle) + float(drawn[2]) * self.onboard.shutter_s
                light = self._strip(strip, during_s, (float(drawn[0]), float(drawn[1])))
                cv2.accumulate(light, total[strip.rows])
        self._cast_shadows(total, len(samples), time_s, row_px)
        blurred = backdrop.lens_blur(cv2.cvtColor(total, cv2.COLOR_BGRA2BGR), self._imaging.lens_blur_px)
        mean = cv2.addWeighted(blurred, 1 / len(samples), blurred, 0.0, 0.0, dtype=cv2.CV_16U)
        return np.asarray(cv2.LUT(mean, _DISPLAY), np.uint8)

    def _strip(
        self, strip: Strip, during_s: float, shift_px: tuple[float, float]
    ) -> UInt16[np.ndarray, "rows width 4"]:
        """(rows, width, 4), light of a strip at one time, and the floor's share."""
        others = [i for i in range(len(self.scene.flights)) if i != self.drone_index]
        posed = [raster.pose(self.scene, drone, np.array([during_s])) for drone in others]

        def draw(view: raster.RasterView) -> UInt16[np.ndarray, "_ _ 4"]:
            view = replace(view, shift_px=shift_px)
            light = np.empty((*view.shape, 4), np.uint16)
            self._painter.paint(view, light)
            # A drone beside the camera reaches behind the camera and has no window, but is not visible.
            visible = [drone for drone in posed if _may_be_seen(drone, view)]
            for window, drones in raster.windows(view, visible, raster.margin_px(0.0)):
                faces_m = np.concatenate([drone.faces_m[0] for drone in drones])
                seen = raster.sample(window, drones, 0, self._painter.hiding_depth_m(window, faces_m))
                part = light[window.slices_in(view)]
                mixed = seen[..., 3:] * part
                mixed[..., :3] += backdrop.LIGHT_UNIT * seen[..., :3]
                part[...] = (mixed + 0.5).astype(np.uint16)
            return light

        return show_strip(self._lens, strip, self.cam_at(during_s), draw)

    def _row_time_s(self, time_s: float, row: float) -> float:
        """When the middle of the exposure of a row is, for a frame whose middle row is exposed at `time_s`."""
        return time_s + self.onboard.line_time_s / self.scene.scale * (row - (self.height - 1) / 2)

    def _row_motion_px(self, time_s: float) -> float:
        """Motion of the image between the exposures of two neighbouring rows, pixels, as in `_motion_px`."""
        ends_s = np.array([self._row_time_s(time_s, row) for row in (0.0, self.height - 1.0)])
        return self._motion_px(ends_s) / self.height if self.onboard.line_time_s else 0.0

    def _samples(self, time_s: float) -> raster.Samples:
        """(samples, 3), positions in the pixel (x, y) and times in the exposure (-1/2 to 1/2), with mean 0."""
        during_s = time_s + np.array([-0.5, 0.5]) * self.onboard.shutter_s
        blur_px = self._motion_px(during_s)
        num = int(np.clip(np.ceil(blur_px / _BLUR_PER_SAMPLE_PX), _MIN_SAMPLES, _MAX_SAMPLES))
        points = np.empty((num, 3))
        points[:, :2] = (np.arange(num)[:, None] * _RECURRENCE) % 1 * self._imaging.antialiasing
        points[:, 2] = (np.arange(num) + 0.5) / num
        return points - points.mean(axis=0)

    def _motion_px(self, during_s: Float[np.ndarray, "2"]) -> float:
        """Upper bound of the image motion between two times, pixels, for objects beyond `_NEAR_SCENERY_M`."""
        position_m, to_world = _poses(self.scene, self.drone_index, during_s)
        turned_rad = Rotation.from_matrix(to_world[0].T @ to_world[1]).magnitude()
        moved_m = np.linalg.norm(position_m[1] - position_m[0])
        return float(self.K[0, 0] * (turned_rad + moved_m / _NEAR_SCENERY_M))

    def _cast_shadows(
        self, total: Float[np.ndarray, "height width 4"], num_samples: int, time_s: float, row_px: float
    ) -> None:
        """Darken the floor in a sum of samples by the shadows in the middle of the exposure."""
        if not self._imaging.shadows:
            return
        lost = cv2.convertScaleAbs(self._floor.floor_gain(time_s), alpha=-255, beta=255)

        def draw(view: raster.RasterView) -> UInt8[np.ndarray, "_ _"]:
            H = raster.from_corner(view.x, view.y) @ self._floor.to_image(view.cam)
            return cv2.warpPerspective(lost, H, view.shape[::-1], flags=cv2.INTER_LINEAR)

        seen = np.zeros(total.shape[:2], np.uint8)
        for strip in strips(self.height, row_px, 0, 1):
            cam = self.cam_at(self._row_time_s(time_s, strip.middle))
            seen[strip.rows] = show_strip(self._lens, strip, cam, draw)
        # Above the horizon, a pixel's line meets the floor behind the camera; the floor's share is 0 at these pixels.
        x, y, width, height = cv2.boundingRect(seen)
        part = total[y : y + height, x : x + width]
        floor = part[..., 3:] / np.float32(backdrop.LIGHT_UNIT * num_samples)
        part[..., :3] *= 1 - seen[y : y + height, x : x + width, None] / np.float32(255) * floor


@functools.lru_cache(maxsize=1)
def _room_painter(hall: str, with_markers: bool, scale: float) -> backdrop.RoomPainter:
    """Painter of the room, shared by the cameras of all drones."""
    return backdrop.RoomPainter(room(hall, with_markers, scale).surfaces)


def camera_record(scene: Scene) -> OnboardCamera:
    """On-board camera of the scenario; the default `OnboardCamera` if the scenario has none."""
    return scene.scenario.onboard or OnboardCamera()


def intrinsics(scene: Scene) -> tuple[raster.Matrix, tuple[int, int]]:
    """Intrinsics (3, 3) of the on-board cameras, and width and height of their images, at the scene's scale.

    Raises:
        SettingsError: images of this scale are too small, or too large for a video.
    """
    record, scale = camera_record(scene), scene.scale
    sized = msgspec.structs.replace(scene.scenario, image_size_wh=record.image_size_wh)
    K = np.eye(3)
    for axis, (side, fov_deg) in enumerate(zip(record.image_size_wh, record.fov_deg, strict=True)):
        K[axis, axis] = scale * side / 2 / np.tan(np.radians(fov_deg) / 2)
        # Pixel centres have integer coordinates, so the middle of an even number of pixels is between two pixels.
        K[axis, 2] = scale * side / 2 - 0.5
    return K, image_size_wh(sized, scale)


def lens(scene: Scene) -> Camera:
    """Lens of the on-board cameras, at the scene's scale."""
    K, size_wh = intrinsics(scene)
    return make_camera(
        R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=size_wh, dist=camera_record(scene).distortion
    )


def onboard_poses(
    scene: Scene, drone_index: int, num_frames: int
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 4"]]:
    """Poses of a drone's camera in the middle of each exposure; of a rolling shutter, of that of the middle row.

    Returns:
        (frames, 3), camera centres, world, metres; (frames, 4), unit quaternions (w, x, y, z), camera to world, with
        camera axes x right, y down, z ahead.
    """
    position_m, to_world = _poses(scene, drone_index, frame_times_s(scene.scenario, num_frames))
    return position_m, quaternions_wxyz(to_world)


def _poses(
    scene: Scene, drone_index: int, time_s: Float[np.ndarray, "times"]
) -> tuple[Float[np.ndarray, "times 3"], Float[np.ndarray, "times 3 3"]]:
    """(times, 3) centres of a drone's camera, and (times, 3, 3) rotations, camera to world."""
    record, flight = camera_record(scene), scene.flights[drone_index]
    pitch = np.radians(record.pitch_deg)
    # Camera axes in the body frame: x ahead, y left, z up.
    right = np.array([0.0, -1.0, 0.0])
    ahead = np.array([np.cos(pitch), 0.0, np.sin(pitch)])
    to_body = np.stack([right, np.cross(ahead, right), ahead], axis=-1)
    rotation = flight.rotation(time_s)
    return flight.position_m(time_s) + rotation @ np.array(record.position_m), rotation @ to_body


def _may_be_seen(posed: raster.PosedDrone, view: raster.RasterView) -> bool:
    points = np.concatenate([posed.faces_m, posed.discs_m], axis=1).reshape(-1, 3)
    return bool(backdrop.may_be_seen((points @ view.cam.R.T + view.cam.t_m)[None], view.K, view.shape)[0])

"""A scene: flights, drone models, room and cameras of one scenario for one seed, checked and ready to be drawn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import SettingsError, check_positive
from psotrack.geometry import (
    FISHEYE_COEFFICIENTS,
    PINHOLE_COEFFICIENTS,
    Camera,
    Rig,
    look_at,
    make_camera,
    make_rig,
)
from psotrack.simulation.flights.motion import Flight
from psotrack.simulation.flights.planning import frame_times_s, plan
from psotrack.simulation.scenarios import (
    CameraPlace,
    OnboardCamera,
    Scenario,
    Vector,
    preset_names,
    scenario,
    scenario_error,
)
from psotrack.simulation.world.drones import MODELS, DroneModel, marker_cross, model
from psotrack.simulation.world.rooms import HALLS, RIGS, Hall, Room, room

#: Largest relative difference between a pixel's width and height. The paper's GoPro has 0.0002.
_SQUARE = 0.05


def check_scenario(scenario: Scenario) -> None:
    """Refuse a scenario that cannot be drawn, before its flights are planned.

    Raises:
        SettingsError: the hall, the rig or a model does not exist; a camera is outside the hall, inside a piece of
            furniture, or has no viewing direction; the limits are outside the hall; an exposure is longer than the time
            between two frames; or the on-board camera cannot be a pinhole camera. The message names the field.
    """
    if scenario.hall not in HALLS:
        raise scenario_error(scenario, "hall", f"one of {', '.join(HALLS)}", scenario.hall)
    for index, drone in enumerate(scenario.drones):
        if isinstance(drone.model, str) and drone.model not in MODELS:
            expected = f"one of {', '.join(MODELS)}, or a mesh"
            raise scenario_error(scenario, f"drones[{index}].model", expected, drone.model)
    hall = HALLS[scenario.hall]
    for index, place in enumerate(camera_places(scenario)):
        _check_camera(scenario, index, place, hall)
    _check_bounds(scenario, hall)
    _check_exposure(scenario, "imaging", scenario.imaging.shutter_s, scenario.imaging.exposure)
    if scenario.onboard:
        _check_exposure(scenario, "onboard", scenario.onboard.shutter_s, scenario.onboard.exposure)
        _check_onboard(scenario, scenario.onboard)


def check_flights(scenario: Scenario, flights: tuple[Flight, ...]) -> None:
    """Refuse flights through furniture.

    Raises:
        SettingsError: a drone is inside a piece of furniture; the message says which drone, where and when.
    """
    time_s = frame_times_s(scenario, scenario.num_frames)
    for index, flight in enumerate(flights):
        position_m = flight.position_m(time_s)
        hit = _in_furniture(position_m, HALLS[scenario.hall])
        if hit.any():
            at = int(np.argmax(hit))
            x, y, z = position_m[at]
            found = f"[{x:.3f}, {y:.3f}, {z:.3f}] at {time_s[at]:.2f} s, inside of it"
            raise scenario_error(scenario, f"drones[{index}].flight", "a way around the furniture", found)


def camera_places(scenario: Scenario) -> tuple[CameraPlace, ...]:
    """Cameras of a scenario, listed in the scenario or taken from the rig that the scenario names.

    Raises:
        SettingsError: the named rig does not exist; the message lists the rigs.
    """
    if not isinstance(scenario.cameras, str):
        return scenario.cameras
    if scenario.cameras not in RIGS:
        raise scenario_error(scenario, "cameras", f"one of {', '.join(RIGS)}, or a list", scenario.cameras)
    return RIGS[scenario.cameras]


def _check_camera(scenario: Scenario, index: int, place: CameraPlace, hall: Hall) -> None:
    refusal = partial(scenario_error, scenario)
    field, found = f"cameras[{index}].position_m", f"{list(place.position_m)}"
    if isinstance(scenario.cameras, str):
        field, found = "cameras", f"{found} of camera {index + 1} of {scenario.cameras}"
    if not _inside(place.position_m, hall):
        raise refusal(field, f"a place in the hall, {_extent(hall)}", found)
    if _in_furniture(np.array([place.position_m]), hall).any():
        raise refusal(field, "a place outside of the furniture", found)
    counts, of_lens = (
        ((0, FISHEYE_COEFFICIENTS), " of a fisheye") if place.fisheye else (PINHOLE_COEFFICIENTS, "")
    )
    if len(place.distortion) not in counts:
        expected = f"{', '.join(map(str, counts))} coefficients{of_lens}"
        raise refusal(f"cameras[{index}].distortion", expected, len(place.distortion))
    away = np.subtract(place.target_m, place.position_m)
    if np.hypot(away[0], away[1]) < 1e-6:
        expected = "a point that is not straight above or below the camera, nor at its place"
        raise refusal(f"cameras[{index}].target_m", expected, place.target_m)


def _check_bounds(scenario: Scenario, hall: Hall) -> None:
    lower_m, upper_m = scenario.limits.lower_m, scenario.limits.upper_m
    for name, corner_m in (("lower_m", lower_m), ("upper_m", upper_m)):
        if not _inside(corner_m, hall):
            raise scenario_error(
                scenario, f"limits.{name}", f"a point in the hall, {_extent(hall)}", corner_m
            )
    if not np.all(np.less(lower_m, upper_m)):
        expected = f"less than limits.upper_m, {list(upper_m)}, along each axis"
        raise scenario_error(scenario, "limits.lower_m", expected, lower_m)


def _check_exposure(scenario: Scenario, part: str, shutter_s: float, exposure: tuple[float, float]) -> None:
    if shutter_s > 1 / scenario.fps:
        expected = f"at most {1 / scenario.fps:g} s, the time between two frames"
        raise scenario_error(scenario, f"{part}.shutter_s", expected, f"{shutter_s:g}")
    if exposure[0] > exposure[1]:
        raise scenario_error(scenario, f"{part}.exposure", "the smaller factor first", exposure)


def _check_onboard(scenario: Scenario, camera: OnboardCamera) -> None:
    refusal = partial(scenario_error, scenario)
    (width, height), frame_s = camera.image_size_wh, 1 / scenario.fps
    if camera.line_time_s * height > frame_s:
        most_s = f"at most {frame_s / height:.3g} s"
        expected = f"{most_s}: {height} rows in {frame_s:g} s, the time between two frames"
        raise refusal("onboard.line_time_s", expected, f"{camera.line_time_s:g}")
    if len(camera.distortion) not in PINHOLE_COEFFICIENTS:
        expected = f"{', '.join(map(str, PINHOLE_COEFFICIENTS))} coefficients"
        raise refusal("onboard.distortion", expected, len(camera.distortion))
    if max(camera.fov_deg) >= 180:
        raise refusal("onboard.fov_deg", "angles below 180 degrees", camera.fov_deg)
    half_width, half_height = np.tan(np.radians(camera.fov_deg) / 2)
    if abs(half_width * height / (half_height * width) - 1) > _SQUARE:
        fits = np.degrees(2 * np.arctan(half_width * height / width))
        pixels = f"angles that fit {width} x {height} square pixels"
        raise refusal("onboard.fov_deg", f"{pixels}, {camera.fov_deg[0]:g} and {fits:.4g}", camera.fov_deg)


def _inside(point_m: Vector, hall: Hall) -> bool:
    length, width, height = hall.size_m
    return abs(point_m[0]) < length / 2 and abs(point_m[1]) < width / 2 and 0 < point_m[2] < height


def _extent(hall: Hall) -> str:
    length, width, height = hall.size_m
    return f"x within {length / 2:g} m of 0, y within {width / 2:g} m, z from 0 to {height:g} m"


def _in_furniture(points_m: Float[np.ndarray, "points 3"], hall: Hall) -> Bool[np.ndarray, "points"]:
    """(points,), whether each point is inside one of the hall's boxes."""
    corners = np.array([(box.lower_m, box.upper_m) for box in hall.boxes]).reshape(-1, 2, 3)
    inside = (points_m[:, None] >= corners[:, 0]) & (points_m[:, None] <= corners[:, 1])
    return np.any(np.all(inside, axis=-1), axis=-1)


#: Smallest and largest side of an image, pixels. Smaller images show nothing; larger images cannot be written, because
#: MPEG-4 stores a side in 13 bits.
_MIN_SIDE_PX, _MAX_SIDE_PX = 32, 8190


@dataclass(frozen=True)
class Scene:
    """Everything that a camera can see.

    Attributes:
        scenario: the scenario.
        seed: seed of the flights and the noise.
        scale: scale of the image size; 1 is full size.
        rig: static cameras at this scale.
        flights: flight of each drone.
        models: model of each drone.
        start_s: time of frame 0, seconds.
    """

    scenario: Scenario
    seed: int
    scale: float
    rig: Rig
    flights: tuple[Flight, ...]
    models: tuple[DroneModel, ...]
    start_s: float = 0.0

    @property
    def room(self) -> Room:
        """Room with textures at the resolution that the scale needs; built at the first use in a process."""
        return room(self.scenario.hall, self.scenario.markers, self.scale)

    def time_s(self, frame: int) -> float:
        """Time of the middle of a frame's exposure, seconds."""
        return self.start_s + frame / self.scenario.fps

    def positions_m(self, num_frames: int) -> Float[np.ndarray, "frames drones 3"]:
        """(frames, drones, 3), ground truth: body origins in the middle of each exposure, world, metres."""
        time_s = frame_times_s(self.scenario, num_frames)
        return np.stack([flight.position_m(time_s) for flight in self.flights], axis=1)

    def orientations_wxyz(self, num_frames: int) -> Float[np.ndarray, "frames drones 4"]:
        """(frames, drones, 4), ground truth: unit quaternions, body to world."""
        time_s = frame_times_s(self.scenario, num_frames)
        return np.stack([flight.orientation_wxyz(time_s) for flight in self.flights], axis=1)

    def mocap_markers_m(self, num_frames: int) -> Float[np.ndarray, "frames drones 4 3"]:
        """(frames, drones, 4, 3), ground truth: mocap markers A, B, C and D of each drone, world, metres."""
        time_s = frame_times_s(self.scenario, num_frames)
        markers = [
            marker_cross(shape, number) @ flight.rotation(time_s).swapaxes(-1, -2)
            + flight.position_m(time_s)[:, None]
            for number, (shape, flight) in enumerate(zip(self.models, self.flights, strict=True), start=1)
        ]
        return np.stack(markers, axis=1)


def build(scenario: Scenario, *, scale: float = 1.0, seed: int = 0) -> Scene:
    """Build the scene of a scenario.

    Args:
        scenario: the scenario.
        scale: scale of the image size; 1 is full size.
        seed: seed of the flights and the noise, 0 or more.

    Raises:
        SettingsError: the scale is not above 0 or gives too small or too large images, the seed is negative, a hall,
            rig or model does not exist, or the scenario does not fit its hall or cannot keep its limits.
        InputError: a mesh or a recorded flight cannot be used.
    """
    check_positive("scale", scale)
    if seed < 0:
        raise SettingsError("seed", expected="0 or more", found=f"{seed}")
    check_scenario(scenario)
    cameras = (_camera(place, scenario, scale) for place in camera_places(scenario))
    rig = make_rig({f"cam{number}": camera for number, camera in enumerate(cameras, start=1)})
    models = tuple(model(drone.model) for drone in scenario.drones)
    flights = plan(scenario, seed)
    check_flights(scenario, flights)
    return Scene(scenario, seed, scale, rig, flights, models)


def _camera(place: CameraPlace, scenario: Scenario, scale: float) -> Camera:
    R, t_m = look_at(place.position_m, place.target_m)
    focal = place.focal_length_px * scale
    # Pixel centres have integer coordinates, so the image's corner, which the scale does not move, is at -0.5.
    cx, cy = ((at + 0.5) * scale - 0.5 for at in place.principal_point_px)
    K = np.array([[focal, place.skew_px * scale, cx], [0.0, focal * place.aspect, cy], [0.0, 0.0, 1.0]])
    size_wh = image_size_wh(scenario, scale)
    return make_camera(R=R, t_m=t_m, K=K, image_size_wh=size_wh, dist=place.distortion, fisheye=place.fisheye)


def image_size_wh(scenario: Scenario, scale: float) -> tuple[int, int]:
    """Width and height of the static cameras' images at a scale, even numbers as video codecs need.

    Raises:
        SettingsError: images of this scale are too small, or too large for a video.
    """
    sides = [side * scale for side in scenario.image_size_wh]
    if max(sides) > _MAX_SIDE_PX:
        found = " x ".join(f"{side:.7g}" for side in sides)
        raise SettingsError("scale", expected=f"images of at most {_MAX_SIDE_PX} pixels a side", found=found)
    width, height = (2 * round(side / 2) for side in sides)
    if min(width, height) < _MIN_SIDE_PX:
        found = f"{width} x {height}"
        raise SettingsError("scale", expected=f"images of at least {_MIN_SIDE_PX} pixels a side", found=found)
    return width, height


def catalogue() -> list[dict[str, Any]]:
    """One record per scenario of the package; the speed is the mean over drones and frames for seed 0."""
    rows = []
    for name in preset_names():
        recipe = scenario(name)
        scene = build(recipe)
        position_m = scene.positions_m(recipe.num_frames)
        speed = np.linalg.norm(np.diff(position_m, axis=0), axis=-1).mean() * recipe.fps
        rows.append(
            {
                "name": name,
                "drones": len(recipe.drones),
                "cameras": len(scene.rig.names),
                "frames": recipe.num_frames,
                "seconds": recipe.num_frames / recipe.fps,
                "hall": recipe.hall,
                "mean_speed_m_s": round(float(speed), 3),
                "markers": recipe.markers,
                "onboard": recipe.onboard is not None,
                "description": recipe.description,
            }
        )
    return rows

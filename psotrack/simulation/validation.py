"""Checks that a scenario fits the halls, camera rigs and drone models of the package."""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from psotrack.geometry import FISHEYE_COEFFICIENTS, PINHOLE_COEFFICIENTS
from psotrack.simulation.flights.motion import Flight
from psotrack.simulation.flights.planning import frame_times_s
from psotrack.simulation.scenarios import CameraPlace, OnboardCamera, Scenario, Vector, scenario_error
from psotrack.simulation.world.drones import MODELS
from psotrack.simulation.world.halls import HALLS, RIGS, Hall

#: Largest relative difference between a pixel's width and height. The paper's GoPro has 0.0002.
_SQUARE = 0.05


def check(scenario: Scenario) -> None:
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

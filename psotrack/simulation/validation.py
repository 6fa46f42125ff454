"""Checks that a scenario fits the halls, camera rigs and drone models of the package."""

from __future__ import annotations

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
    _check_named(scenario)
    hall = HALLS[scenario.hall]
    for index, place in enumerate(camera_places(scenario)):
        _check_camera(scenario, index, place, hall)
    _check_bounds(scenario, hall)
    _check_shutter(scenario, "imaging.shutter_s", scenario.imaging.shutter_s)
    _check_exposure(scenario, "imaging.exposure", scenario.imaging.exposure)
    if scenario.onboard:
        _check_shutter(scenario, "onboard.shutter_s", scenario.onboard.shutter_s)
        _check_exposure(scenario, "onboard.exposure", scenario.onboard.exposure)
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
            raise scenario_error(
                scenario,
                f"drones[{index}].flight",
                expected="a way around the furniture",
                found=f"[{x:.3f}, {y:.3f}, {z:.3f}] at {time_s[at]:.2f} s, inside of it",
            )


def camera_places(scenario: Scenario) -> tuple[CameraPlace, ...]:
    """Cameras of a scenario, listed in the scenario or taken from the rig that the scenario names.

    Raises:
        SettingsError: the named rig does not exist; the message lists the rigs.
    """
    if not isinstance(scenario.cameras, str):
        return scenario.cameras
    if scenario.cameras not in RIGS:
        raise scenario_error(
            scenario, "cameras", expected=f"one of {', '.join(RIGS)}, or a list", found=scenario.cameras
        )
    return RIGS[scenario.cameras]


def _check_named(scenario: Scenario) -> None:
    if scenario.hall not in HALLS:
        raise scenario_error(scenario, "hall", expected=f"one of {', '.join(HALLS)}", found=scenario.hall)
    for index, drone in enumerate(scenario.drones):
        if isinstance(drone.model, str) and drone.model not in MODELS:
            expected = f"one of {', '.join(MODELS)}, or a mesh"
            raise scenario_error(scenario, f"drones[{index}].model", expected=expected, found=drone.model)


def _check_camera(scenario: Scenario, index: int, place: CameraPlace, hall: Hall) -> None:
    of_rig = isinstance(scenario.cameras, str)
    field = "cameras" if of_rig else f"cameras[{index}].position_m"
    found = f"{list(place.position_m)}" + (f" of camera {index + 1} of {scenario.cameras}" if of_rig else "")
    if not _inside(place.position_m, hall):
        raise scenario_error(scenario, field, expected=f"a place in the hall, {_extent(hall)}", found=found)
    if _in_furniture(np.array([place.position_m]), hall).any():
        raise scenario_error(scenario, field, expected="a place outside of the furniture", found=found)
    allowed = (0, FISHEYE_COEFFICIENTS) if place.fisheye else PINHOLE_COEFFICIENTS
    if len(place.distortion) not in allowed:
        raise scenario_error(
            scenario,
            f"cameras[{index}].distortion",
            expected=f"{', '.join(map(str, allowed))} coefficients{' of a fisheye' if place.fisheye else ''}",
            found=f"{len(place.distortion)}",
        )
    away = np.subtract(place.target_m, place.position_m)
    if np.hypot(away[0], away[1]) < 1e-6:
        raise scenario_error(
            scenario,
            f"cameras[{index}].target_m",
            expected="a point that is not straight above or below the camera, nor at its place",
            found=f"{list(place.target_m)}",
        )


def _check_bounds(scenario: Scenario, hall: Hall) -> None:
    limits = scenario.limits
    for name in ("lower_m", "upper_m"):
        corner = getattr(limits, name)
        if not _inside(corner, hall):
            raise scenario_error(
                scenario,
                f"limits.{name}",
                expected=f"a point in the hall, {_extent(hall)}",
                found=f"{list(corner)}",
            )
    if not np.all(np.less(limits.lower_m, limits.upper_m)):
        raise scenario_error(
            scenario,
            "limits.lower_m",
            expected=f"less than limits.upper_m, {list(limits.upper_m)}, along each axis",
            found=f"{list(limits.lower_m)}",
        )


def _check_exposure(scenario: Scenario, field: str, exposure: tuple[float, float]) -> None:
    if exposure[0] > exposure[1]:
        raise scenario_error(scenario, field, expected="the smaller factor first", found=f"{list(exposure)}")


def _check_shutter(scenario: Scenario, field: str, shutter_s: float) -> None:
    if shutter_s > 1 / scenario.fps:
        expected = f"at most {1 / scenario.fps:g} s, the time between two frames"
        raise scenario_error(scenario, field, expected=expected, found=f"{shutter_s:g}")


def _check_onboard(scenario: Scenario, camera: OnboardCamera) -> None:
    readout_s, frame_s = camera.line_time_s * camera.image_size_wh[1], 1 / scenario.fps
    if readout_s > frame_s:
        raise scenario_error(
            scenario,
            "onboard.line_time_s",
            expected=f"at most {frame_s / camera.image_size_wh[1]:.3g} s: {camera.image_size_wh[1]} rows in"
            f" {frame_s:g} s, the time between two frames",
            found=f"{camera.line_time_s:g}",
        )
    if len(camera.distortion) not in PINHOLE_COEFFICIENTS:
        expected = f"{', '.join(map(str, PINHOLE_COEFFICIENTS))} coefficients"
        raise scenario_error(
            scenario, "onboard.distortion", expected=expected, found=f"{len(camera.distortion)}"
        )
    if max(camera.fov_deg) >= 180:
        raise scenario_error(
            scenario, "onboard.fov_deg", expected="angles below 180 degrees", found=f"{list(camera.fov_deg)}"
        )
    half_width, half_height = np.tan(np.radians(camera.fov_deg) / 2)
    width, height = camera.image_size_wh
    if abs(half_width * height / (half_height * width) - 1) > _SQUARE:
        fits = np.degrees(2 * np.arctan(half_width * height / width))
        raise scenario_error(
            scenario,
            "onboard.fov_deg",
            expected=f"angles that fit {width} x {height} square pixels, {camera.fov_deg[0]:g} and {fits:.4g}",
            found=f"{list(camera.fov_deg)}",
        )


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

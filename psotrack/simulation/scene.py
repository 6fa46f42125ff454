"""A scene: flights, drone models, room and cameras of one scenario for one seed, ready to be drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError, check_positive
from psotrack.geometry import Camera, Rig, look_at, make_camera, make_rig
from psotrack.simulation.flights.motion import Flight
from psotrack.simulation.flights.planning import frame_times_s, plan
from psotrack.simulation.scenarios import CameraPlace, Scenario
from psotrack.simulation.validation import camera_places, check, check_flights
from psotrack.simulation.world.drones import DroneModel, marker_cross, model
from psotrack.simulation.world.rooms import Room, room

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
    check(scenario)
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

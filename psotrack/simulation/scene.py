"""A scene: one scenario with one seed, ready to be drawn: flights, drones, room and rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.cameras import Camera, CameraRig, camera, look_at, stack
from psotrack.errors import SettingsError, check_positive
from psotrack.simulation.drones import DroneModel, model
from psotrack.simulation.flights import Flight, frame_times_s, plan
from psotrack.simulation.rooms import Room, room
from psotrack.simulation.scenarios import CameraPlace, Scenario

#: A texel of the floor at full size; about a pixel at the nearest distance that drones are seen at.
_TEXEL_M = 0.005
#: Smaller pictures than this show nothing.
_MIN_SIDE_PX = 32


@dataclass(frozen=True)
class Scene:
    """Everything that a camera could see.

    Attributes:
        scenario: the record.
        seed: what varies the flights and the noise.
        scale: of images, 1 is full size.
        rig: the cameras at that scale.
        flights: one per drone.
        models: one per drone.
    """

    scenario: Scenario
    seed: int
    scale: float
    rig: CameraRig
    flights: tuple[Flight, ...]
    models: tuple[DroneModel, ...]

    @property
    def room(self) -> Room:
        """The room, its textures as fine as the scale needs; built at the first use in a process."""
        texel_m = round(max(_TEXEL_M, min(_TEXEL_M / self.scale, 0.04)), 3)
        return room(self.scenario.room, self.scenario.markers, texel_m)

    def time_s(self, frame: int) -> float:
        """Middle of the exposure of a frame."""
        return frame / self.scenario.fps

    def positions_m(self, num_frames: int) -> Float[np.ndarray, "frames drones 3"]:
        """(frames, drones, 3), the truth: where the body origins are in the middle of each exposure."""
        time_s = frame_times_s(self.scenario, num_frames)
        return np.stack([flight.position_m(time_s) for flight in self.flights], axis=1)

    def orientations_wxyz(self, num_frames: int) -> Float[np.ndarray, "frames drones 4"]:
        """(frames, drones, 4), the truth: unit quaternions, body to world."""
        time_s = frame_times_s(self.scenario, num_frames)
        return np.stack([flight.orientation_wxyz(time_s) for flight in self.flights], axis=1)


def build(scenario: Scenario, *, scale: float = 1.0, seed: int = 0) -> Scene:
    """The scene of a scenario.

    Raises:
        SettingsError: the scale is not above 0 or gives images of almost no pixels, the seed is negative, or the
            scenario names what does not exist or cannot keep its limits.
    """
    check_positive("scale", scale)
    if seed < 0:
        raise SettingsError("seed", expected="0 or more", found=f"{seed}")
    places = {f"cam{i}i": place for i, place in enumerate(scenario.cameras, start=1)}
    rig = stack({name: _camera(place, scenario, scale) for name, place in places.items()})
    models = tuple(model(drone.model) for drone in scenario.drones)
    return Scene(scenario, seed, scale, rig, plan(scenario, seed), models)


def image_size_wh(scenario: Scenario, scale: float) -> tuple[int, int]:
    """Width and height at a scale, even because video codecs want them so."""
    width, height = (2 * round(side * scale / 2) for side in scenario.image_size_wh)
    if min(width, height) < _MIN_SIDE_PX:
        raise SettingsError(
            "scale", expected=f"images of at least {_MIN_SIDE_PX} pixels a side", found=f"{width} x {height}"
        )
    return width, height


def _camera(place: CameraPlace, scenario: Scenario, scale: float) -> Camera:
    R, t_m = look_at(place.position_m, place.target_m)
    focal = place.focal_length_px * scale
    # Pixel centres are at integers, so the corner of the image, which stays where it is, is at -0.5.
    cx, cy = ((centre + 0.5) * scale - 0.5 for centre in place.principal_point_px)
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return camera(R=R, t_m=t_m, K=K, image_size_wh=image_size_wh(scenario, scale))

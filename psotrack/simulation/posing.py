"""Drones put into the world: their faces and rotor discs at several times of one exposure, with light on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.simulation.drones import disc_fans
from psotrack.simulation.scene import Scene

#: Reflectance of what is not painted.
_DARK_PLASTIC = 0.02
#: Of a rotor disc, blades smeared by their turning: opacity at the hub and at the tip, reflectance.
_DISC_OPACITY = (0.55, 0.30)
_DISC_REFLECTANCE = 0.06


@dataclass(frozen=True)
class PosedDrone:
    """One drone during one exposure.

    Attributes:
        faces_m: (times, faces, 3, 3), world.
        light: (faces, 1, 3), linear BGR; one light for the whole exposure.
        discs_m: (times, slices, 3, 3), rotor discs as fans, hub first.
        disc_opacity_light: (slices, 3, 3) at the corners: opacity and light in the first two channels.
    """

    faces_m: Float[np.ndarray, "times faces 3 3"]
    light: Float[np.ndarray, "faces 1 3"]
    discs_m: Float[np.ndarray, "times slices 3 3"]
    disc_opacity_light: Float[np.ndarray, "slices 3 3"]


def pose(scene: Scene, drone: int, time_s: Float[np.ndarray, "times"]) -> PosedDrone:
    """A drone of a scene at some times of one exposure."""
    flight, shape = scene.flights[drone], scene.models[drone]
    rotation, position = flight.rotation(time_s), flight.position_m(time_s)
    turn = rotation.swapaxes(-1, -2)[:, None]
    middle = len(time_s) // 2
    normals = shape.normals @ rotation[middle].T
    panels = scene.room.panels
    paint = np.array(scene.scenario.drones[drone].paint_bgr)
    reflectance = _DARK_PLASTIC + shape.paint[:, None] * (paint - _DARK_PLASTIC)
    light = reflectance * panels.on_faces(position[middle], normals)[:, None]
    discs = disc_fans(shape)
    shade = _DISC_REFLECTANCE * panels.on_faces(position[middle], rotation[middle, :, 2][None])[0]
    hub, tip = _DISC_OPACITY
    corner_values = np.array([(hub, shade, 0.0), (tip, shade, 0.0), (tip, shade, 0.0)])
    return PosedDrone(
        faces_m=shape.triangles_m @ turn + position[:, None, None],
        light=light[:, None],
        discs_m=discs @ turn + position[:, None, None],
        disc_opacity_light=np.broadcast_to(corner_values, discs.shape),
    )

"""The five drone models of the package, from `drones.toml`, and the model of a scenario's drone."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float

from psotrack.simulation.scenarios import Mesh, Vector
from psotrack.simulation.world import models
from psotrack.simulation.world.meshes import load
from psotrack.simulation.world.models import DroneModel as DroneModel
from psotrack.simulation.world.models import Triangles
from psotrack.simulation.world.models import disc_fans as disc_fans

#: Height of the markers above the highest point of the drone, so that the drone does not hide them from above.
_MAST_M = 0.03


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of a drone, raised at its front by `pitch_deg` about a line through `about_m` along y."""

    shape: Literal["box", "cylinder", "beam"]
    of: tuple[Vector | float | int, ...]
    paint: float
    pitch_deg: float = 0.0
    about_m: Vector = (0.0, 0.0, 0.0)

    def triangles_m(self) -> Triangles:
        """The part's surface in the body frame."""
        triangles_m: Triangles = getattr(models, self.shape)(*self.of)
        if self.pitch_deg:
            return models.pitch(triangles_m, np.radians(self.pitch_deg), self.about_m)
        return triangles_m


class Group(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parts and motors that are turned about the z axis to each angle of `at_deg`."""

    parts: tuple[Part, ...]
    at_deg: tuple[float, ...] = (0.0,)
    motors_m: tuple[Vector, ...] = ()


class Plan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a drone is made of."""

    rotor_radius_m: float
    groups: tuple[Group, ...]


class _Plans(msgspec.Struct, frozen=True):
    cross_arms_m: tuple[tuple[float, float, float, float], ...]
    models: dict[str, Plan]


_PLANS = msgspec.toml.decode(
    resources.files("psotrack.simulation.world").joinpath("drones.toml").read_bytes(), type=_Plans
)
MODELS: Mapping[str, Plan] = _PLANS.models


def model(name: str | Mesh) -> DroneModel:
    """Drone model with a name in `MODELS`, or from a mesh.

    Raises:
        InputError: the mesh cannot be used.
    """
    if isinstance(name, Mesh):
        return load(name)
    plan = MODELS[name]
    parts: list[tuple[Triangles, float]] = []
    motors: list[Float[np.ndarray, "3"]] = []
    for group in plan.groups:
        for angle in np.radians(group.at_deg):
            parts += [(models.turn(part.triangles_m(), angle), part.paint) for part in group.parts]
            motors += [models.turn(np.array(motor), angle) for motor in group.motors_m]
    for x, y, z in motors:
        parts.append((models.cylinder((x, y, z), 0.014, 0.026), 0.1))
        parts.append((models.cylinder((x, y, z + 0.017), 0.006, 0.010, sides=6), 0.0))
    triangles = np.concatenate([triangles for triangles, _ in parts])
    paint = np.concatenate([np.full(len(triangles), share) for triangles, share in parts])
    rotors = np.array(motors) + np.array([0.0, 0.0, 0.020])
    return DroneModel(triangles, paint, rotors, np.full(len(motors), plan.rotor_radius_m))


def marker_cross(shape: DroneModel, number: int) -> Float[np.ndarray, "4 3"]:
    """(4, 3), mocap markers A, B, C and D of a drone in its body frame: ahead, left, back, right.

    The markers form an asymmetric cross above the highest point of the model. The arms depend on the drone's number, so
    that a motion capture system can distinguish the drones by the distances between their markers.

    Args:
        shape: shape of the drone.
        number: number of the drone in its sequence, from 1; after the last cross, the first cross is used again.
    """
    ahead, left, back, right = _PLANS.cross_arms_m[(number - 1) % len(_PLANS.cross_arms_m)]
    height = float(shape.triangles_m[..., 2].max()) + _MAST_M
    return np.array([(ahead, 0.0, height), (0.0, left, height), (-back, 0.0, height), (0.0, -right, height)])

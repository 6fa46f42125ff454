"""Drone models: solids of triangles and rotors, five models from `drones.toml`, and meshes of users' files.

The corners of a triangle are counter-clockwise seen from outside, metres.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.simulation.scenarios import Mesh, Vector
from psotrack.support import LARGEST

#: (faces, 3, 3), corners in metres.
Triangles = Float[np.ndarray, "_ 3 3"]
Point = tuple[float, float, float]


def box(centre: Point, size: Point, taper: float = 1.0) -> Triangles:
    """Box whose top is `taper` times as long and wide as its bottom."""
    x, y, z = np.array(size) / 2
    ring = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    return _prism(ring, -z, z, taper) + np.array(centre)


def cylinder(centre: Point, radius: float, height: float, taper: float = 1.0, sides: int = 10) -> Triangles:
    """Upright cylinder whose top is `taper` times as wide as its bottom."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return _prism(ring, -height / 2, height / 2, taper) + np.array(centre)


def beam(start: Point, end: Point, width: float, height: float) -> Triangles:
    """Straight bar of rectangular section between two points, which must not be vertically above each other."""
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    ahead = (b - a) / length
    left = np.cross([0.0, 0.0, 1.0], ahead)
    left /= np.linalg.norm(left)
    bar = box((0.0, 0.0, 0.0), (length, width, height))
    return bar @ np.stack([ahead, left, np.cross(ahead, left)]) + (a + b) / 2


def turn(corners: Float[np.ndarray, "*corners 3"], angle_rad: float) -> Float[np.ndarray, "*corners 3"]:
    """Points turned about the z axis, from x towards y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return corners @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def pitch(triangles: Triangles, angle_rad: float, about: Point) -> Triangles:
    """Triangles turned about a line through `about` along y, from x towards z, which raises the front."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return (triangles - np.array(about)) @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) + np.array(
        about
    )


def _prism(ring: Float[np.ndarray, "sides 2"], bottom: float, top: float, taper: float) -> Triangles:
    low = np.column_stack([ring, np.full(len(ring), bottom)])
    high = np.column_stack([ring * taper, np.full(len(ring), top)])
    low_next, high_next = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
    fan = np.arange(1, len(ring) - 1)
    first = np.zeros_like(fan)
    return np.concatenate(
        [
            np.stack([low, low_next, high_next], axis=1),
            np.stack([low, high_next, high], axis=1),
            high[np.stack([first, fan, fan + 1], axis=1)],
            low[np.stack([first, fan + 1, fan], axis=1)],
        ]
    )


#: Number of corners of a rotor disc.
_DISC_SIDES = 20


@dataclass(frozen=True)
class DroneModel:
    """Shape of a drone in its body frame.

    Attributes:
        triangles_m: (faces, 3, 3), corners counter-clockwise seen from outside.
        paint: (faces,), share of the drone's paint in the colour of a face; the rest is dark plastic.
        rotor_centres_m: (rotors, 3), hubs; the discs are horizontal in the body frame.
        rotor_radii_m: (rotors,), radii of the rotor discs.
    """

    triangles_m: Float[np.ndarray, "faces 3 3"]
    paint: Float[np.ndarray, "faces"]
    rotor_centres_m: Float[np.ndarray, "rotors 3"]
    rotor_radii_m: Float[np.ndarray, "rotors"]

    @functools.cached_property
    def normals(self) -> Float[np.ndarray, "faces 3"]:
        """(faces, 3), outward unit normals of the faces."""
        a, b, c = self.triangles_m.swapaxes(0, 1)
        outwards = np.cross(b - a, c - a)
        return outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)

    @functools.cached_property
    def radius_m(self) -> float:
        """Radius of the smallest sphere about the origin that contains the drone with its rotors."""
        body = np.linalg.norm(self.triangles_m, axis=-1).max()
        reach = np.linalg.norm(self.rotor_centres_m, axis=-1) + self.rotor_radii_m
        return float(max(body, reach.max(initial=0.0)))


def disc_fans(model: DroneModel) -> Triangles:
    """(slices, 3, 3), rotor discs as triangles around their hubs, body frame."""
    angle = 2 * np.pi * np.arange(_DISC_SIDES + 1) / _DISC_SIDES
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    fan = np.stack([np.zeros_like(rim[:-1]), rim[:-1], rim[1:]], axis=1)
    discs = model.rotor_centres_m[:, None, None] + model.rotor_radii_m[:, None, None, None] * fan
    return discs.reshape(-1, 3, 3)


_SUFFIXES = (".obj", ".ply")
#: Smallest and largest extent of a drone. A mesh outside this range is in other units.
_SMALLEST_M, _LARGEST_M = 0.02, 3.0
#: Largest area of a face that is left out. Such faces are lines or points, without a normal.
_NO_AREA_M2 = 1e-12


def load_mesh(mesh: Mesh) -> DroneModel:
    """Read a drone model from a mesh file.

    Polygons become triangles, and faces without an area are left out. Colours, textures and materials are ignored: all
    faces have the drone's paint.

    Args:
        mesh: file, and its place in the body frame.

    Raises:
        InputError: the file does not exist, is not a mesh or has no faces, or the mesh or a rotor does not have the
            size of a drone.
    """
    path = Path(mesh.file)
    refusal = functools.partial(InputError, path, remedy="export it again")
    triangles = mesh.scale * _read(path, refusal) - np.array(mesh.origin_m)
    if not (np.abs(triangles) <= LARGEST).all():
        raise refusal(expected="numbers as vertices", found="NaN, infinity or huge numbers")
    a, b, c = triangles.swapaxes(0, 1)
    kept = triangles[np.linalg.norm(np.cross(b - a, c - a), axis=-1) > 2 * _NO_AREA_M2]
    if not len(kept):
        found = f"{len(triangles)} without" if len(triangles) else "no faces"
        remedy = "export a surface, not points or lines"
        raise refusal(expected="faces with an area", found=found, remedy=remedy)
    extent_m = float(np.ptp(kept, axis=(0, 1)).max())
    if not _SMALLEST_M <= extent_m <= _LARGEST_M:
        expected = f"a drone of {_SMALLEST_M:g} to {_LARGEST_M:g} m over all"
        remedy = "set scale to metres per unit of the file (0.001 for millimetres)"
        raise refusal(expected=expected, found=f"{extent_m:.3g} m", remedy=remedy)
    if np.abs(kept).max() > _LARGEST_M:
        middle_m = (kept.min(axis=(0, 1)) + kept.max(axis=(0, 1))) / 2 + mesh.origin_m
        found = f"the drone's middle at ({', '.join(f'{at:.3g}' for at in middle_m)}) m"
        remedy = "set origin_m to about this point"
        raise refusal(expected="the body origin in or near the drone", found=found, remedy=remedy)
    hubs = np.array([rotor.centre_m for rotor in mesh.rotors], float).reshape(-1, 3)
    radii = np.array([rotor.radius_m for rotor in mesh.rotors], float)
    for number, farthest_m in enumerate(np.linalg.norm(hubs, axis=-1) + radii):
        if farthest_m > _LARGEST_M:
            expected = f"rotors within {_LARGEST_M:g} m of the body origin"
            found = f"rotors[{number}] that reaches {farthest_m:.3g} m"
            remedy = "give centre_m and radius_m in metres; the scale of the mesh does not apply to them"
            raise refusal(expected=expected, found=found, remedy=remedy)
    return DroneModel(kept, np.ones(len(kept)), hubs, radii)


def _read(path: Path, refusal: Callable[..., InputError]) -> Triangles:
    """Triangles of a file, in the file's units."""
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        found, remedy = path.suffix or "no suffix", "export the drone as one of these"
        raise refusal(expected="a mesh, .obj or .ply", found=found, remedy=remedy)
    try:
        content = path.read_bytes()
    except OSError as error:
        found = error.strerror or str(error)
        raise refusal(expected="a mesh file", found=found, remedy="check the drone's model") from error
    # Imported here, because the import is slow and few scenarios need it.
    import trimesh

    try:
        # Names of parts and comments may be in any encoding; they are not used.
        file = io.StringIO(content.decode(errors="replace")) if suffix == ".obj" else io.BytesIO(content)
        with np.errstate(invalid="ignore"):  # damaged numbers of vertices are no vertices, see below
            read = trimesh.load_mesh(file, file_type=suffix[1:], process=False, skip_materials=True)
            vertices = np.asarray(read.vertices, float).reshape(-1, 3)
            faces = np.asarray(read.faces, int).reshape(-1, 3)
    # Each parser of trimesh has different errors.
    except Exception as error:
        raise refusal(expected="a mesh", found=f"a file that cannot be read ({error})") from error
    wrong = faces[(faces < 0) | (faces >= len(vertices))]
    if wrong.size:
        raise refusal(expected=f"faces of its {len(vertices)} vertices", found=f"vertex {wrong[0]}")
    return vertices[faces].reshape(-1, 3, 3)


#: The solids by their names in `drones.toml`.
_SOLIDS: Mapping[str, Callable[..., Triangles]] = {"box": box, "cylinder": cylinder, "beam": beam}
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
        triangles_m = _SOLIDS[self.shape](*self.of)
        if self.pitch_deg:
            return pitch(triangles_m, np.radians(self.pitch_deg), self.about_m)
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
        return load_mesh(name)
    plan = MODELS[name]
    parts: list[tuple[Triangles, float]] = []
    motors: list[Float[np.ndarray, "3"]] = []
    for group in plan.groups:
        for angle in np.radians(group.at_deg):
            parts += [(turn(part.triangles_m(), angle), part.paint) for part in group.parts]
            motors += [turn(np.array(motor), angle) for motor in group.motors_m]
    for x, y, z in motors:
        parts.append((cylinder((x, y, z), 0.014, 0.026), 0.1))
        parts.append((cylinder((x, y, z + 0.017), 0.006, 0.010, sides=6), 0.0))
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

"""Drone models from mesh files, OBJ and PLY."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.simulation.scenarios import Mesh
from psotrack.simulation.world.models import DroneModel
from psotrack.simulation.world.shapes import Triangles
from psotrack.support import LARGEST

_SUFFIXES = (".obj", ".ply")
#: Smallest and largest extent of a drone. A mesh outside this range is in other units.
_SMALLEST_M, _LARGEST_M = 0.02, 3.0
#: Largest area of a face that is left out. Such faces are lines or points, without a normal.
_NO_AREA_M2 = 1e-12


def load(mesh: Mesh) -> DroneModel:
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
    triangles = mesh.scale * _read(path) - np.array(mesh.origin_m)
    if not (np.abs(triangles) <= LARGEST).all():
        found = "NaN, infinity or huge numbers"
        raise InputError(path, expected="numbers as vertices", found=found, remedy="export it again")
    kept = triangles[_area_m2(triangles) > _NO_AREA_M2]
    if not len(kept):
        found = f"{len(triangles)} without" if len(triangles) else "no faces"
        raise InputError(
            path, expected="faces with an area", found=found, remedy="export a surface, not points or lines"
        )
    _check_size(path, mesh, kept.reshape(-1, 3))
    hubs = np.array([rotor.centre_m for rotor in mesh.rotors], float).reshape(-1, 3)
    radii = np.array([rotor.radius_m for rotor in mesh.rotors], float)
    _check_rotors(path, np.linalg.norm(hubs, axis=-1) + radii)
    return DroneModel(kept, np.ones(len(kept)), hubs, radii)


def _read(path: Path) -> Triangles:
    """Triangles of a file, in the file's units."""
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise InputError(
            path,
            expected="a mesh, .obj or .ply",
            found=path.suffix or "no suffix",
            remedy="export the drone as one of these",
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            path, expected="a mesh file", found=error.strerror or str(error), remedy="check the drone's model"
        ) from error
    # Imported here, because the import is slow and few scenarios need it.
    import trimesh

    try:
        # Names of parts and comments may be in any encoding; they are not used.
        file = io.StringIO(content.decode(errors="replace")) if suffix == ".obj" else io.BytesIO(content)
        read = trimesh.load_mesh(file, file_type=suffix[1:], process=False, skip_materials=True)
        vertices = np.asarray(read.vertices, float).reshape(-1, 3)
        faces = np.asarray(read.faces, int).reshape(-1, 3)
    # Each parser of trimesh has different errors.
    except Exception as error:
        raise InputError(
            path, expected="a mesh", found=f"a file that cannot be read ({error})", remedy="export it again"
        ) from error
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise InputError(
            path,
            expected=f"faces of its {len(vertices)} vertices",
            found=f"vertex {faces.min() if faces.min() < 0 else faces.max()}",
            remedy="export it again",
        )
    return vertices[faces].reshape(-1, 3, 3)


def _area_m2(triangles: Triangles) -> Float[np.ndarray, "faces"]:
    a, b, c = triangles.swapaxes(0, 1)
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def _check_size(path: Path, mesh: Mesh, points_m: Float[np.ndarray, "points 3"]) -> None:
    """Raise `InputError` unless points in the body frame have the size of a drone and are near the origin."""
    extent = float(np.ptp(points_m, axis=0).max())
    if not _SMALLEST_M <= extent <= _LARGEST_M:
        raise InputError(
            path,
            expected=f"a drone of {_SMALLEST_M:g} to {_LARGEST_M:g} m over all",
            found=f"{extent:.3g} m",
            remedy="set scale to metres per unit of the file (0.001 for millimetres)",
        )
    if np.abs(points_m).max() > _LARGEST_M:
        middle = (points_m.min(axis=0) + points_m.max(axis=0)) / 2 + mesh.origin_m
        raise InputError(
            path,
            expected="the body origin in or near the drone",
            found=f"the drone's middle at ({', '.join(f'{at:.3g}' for at in middle)}) m",
            remedy="set origin_m to about this point",
        )


def _check_rotors(path: Path, reach_m: Float[np.ndarray, "rotors"]) -> None:
    """Raise `InputError` if a rotor reaches farther from the origin than a drone can."""
    for number, farthest_m in enumerate(reach_m):
        if farthest_m > _LARGEST_M:
            raise InputError(
                path,
                expected=f"rotors within {_LARGEST_M:g} m of the body origin",
                found=f"rotors[{number}] that reaches {farthest_m:.3g} m",
                remedy="give centre_m and radius_m in metres; the scale of the mesh does not apply to them",
            )

"""Drone models from mesh files, OBJ and PLY."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from psotrack.errors import InputError
from psotrack.simulation.scenarios import Mesh
from psotrack.simulation.world.models import DroneModel, Triangles
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

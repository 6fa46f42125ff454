"""The shape of the house: who imports whom, what the core may use, and that importing has no effects.

Imports are read from the syntax tree of every module, those inside of functions too, so that no path is missed.
"""

import ast
import doctest
import importlib
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from helpers import ring_rig

import psotrack
from psotrack.summed_area import box_sum
from psotrack.triangulation import triangulate

PACKAGE = Path(psotrack.__file__).parent

#: A module imports only from smaller depths. A folder is one room: its modules import one another freely.
DEPTH = {
    "__init__": 0,
    "_typing": 0,
    "compiled": 0,
    "errors": -1,
    "camera_names": 0,
    "progress": 0,
    "schema": 2,
    "files": 1,
    "aruco": 1,
    "cameras": 1,
    "crosses": 1,
    "cross_poses": 2,
    "motion": 1,
    "refinement": 1,
    "rotations": 1,
    "summed_area": 1,
    "swarm": 1,
    "trajectories": 1,
    "blobs": 2,
    "boxes": 2,
    "triangulation": 2,
    "delimited": 2,
    "foreground": 2,
    "mocap": 3,
    "processes": 2,
    "smoothing": 2,
    "tum": 2,
    "unexplained": 3,
    "trajectory_files": 2,
    "video": 2,
    "wandering": 1,
    "claims": 3,
    "shadows": 4,
    "patches": 5,
    "fitness": 6,
    "correspondence": 3,
    "detections": 3,
    "evaluation": 3,
    "identity": 3,
    "initialisation": 4,
    "paths": 3,
    "image_fit": 2,
    "reprojection": 3,
    "newcomers": 5,
    "lifecycle": 6,
    "sequence": 3,
    "camera_clocks": 4,
    "detector": 4,
    "detection_store": 5,
    "time_shift": 4,
    "synchronisation": 5,
    "silhouette_store": 3,
    "sizes": 7,
    "tracker": 8,
    "crew": 9,
    "tracker_inputs": 9,
    "datasets": 4,
    "silhouettes": 4,
    "contents": 4,
    "labels": 2,
    "training_data": 4,
    "settings": 4,
    "simulation": 5,
    "starts": 5,
    "calibration": 6,
    "localisation": 7,
    "tracking": 10,
    "sightings": 5,
    "doctor": 9,
    "inside_out": 7,
    "projection_lines": 11,
    "fusion": 11,
    "finishing": 11,
    "methods": 12,
    "pipeline": 13,
    "demo": 14,
    "sweep": 14,
    "cli": 15,
    "__main__": 16,
}

CORE = {
    "camera_names",
    "_typing",
    "cameras",
    "identity",
    "image_fit",
    "localisation",
    "refinement",
    "motion",
    "sizes",
    "smoothing",
    "summed_area",
    "swarm",
    "trajectories",
    "boxes",
    "claims",
    "shadows",
    "patches",
    "fitness",
    "reprojection",
    "tracker",
    "triangulation",
}
CORE_MAY_USE = {"jax", "jaxtyping", "numpy", "optax"}

#: Room -> rooms that it must not import, however their depths are.
STRANGERS = {
    "swarm": {"fitness", "boxes", "cameras"},
    "fitness": {"swarm"},
    "simulation": {"boxes", "fitness", "tracker", "summed_area", "silhouettes", "foreground"},
    "evaluation": {"tracker", "fitness", "boxes", "pipeline"},
}


def imports(source, package="psotrack"):
    """Dotted names of the modules that a source imports when it runs, relative imports resolved in `package`.

    `from a import b` yields a.b too, because b may be a module. What only type checkers read is left out.
    """
    found = set()

    def visit(node):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            for child in node.orelse:
                visit(child)
            return
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*parents, *([node.module] if node.module else [])])
            found.update({module, *(f"{module}.{alias.name}" for alias in node.names)})
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(source))
    return found


def room_of(path):
    """The room of a file relative to the package: its folder, or its own name."""
    return path.parts[0].removesuffix(".py")


def complaints(path, source):
    """What a module at a path relative to the package does that it must not."""
    room = room_of(path)
    if room not in DEPTH:
        return [f"{path}: not in the table of depths"]
    found = imports(source, ".".join(["psotrack", *path.parts[:-1]]))
    wrong = []
    for name in sorted(found):
        top, *rest = name.split(".")
        if top != "psotrack":
            if room in CORE and top not in CORE_MAY_USE and top not in sys.stdlib_module_names:
                wrong.append(f"{path}: the core imports {name}")
            continue
        other = rest[0] if rest and rest[0] in DEPTH else "__init__"
        if other in (room, "__init__") or (other == "__init__" and not rest):
            continue
        if DEPTH[other] >= DEPTH[room]:
            wrong.append(f"{path}: depth {DEPTH[room]} imports {other} of depth {DEPTH[other]}")
        if other in STRANGERS.get(room, ()):
            wrong.append(f"{path}: {room} does not know {other}")
    return wrong


def test_every_module_keeps_to_the_graph():
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        wrong += complaints(path.relative_to(PACKAGE), path.read_text(encoding="utf-8"))
    assert wrong == []


def test_the_table_has_no_rooms_that_are_gone():
    rooms = {room_of(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py")}
    assert set(DEPTH) <= rooms


@pytest.mark.parametrize(
    ("path", "source", "complaint"),
    [
        ("boxes.py", "import cv2", "the core imports cv2"),
        ("tracker.py", "def f():\n    from scipy.optimize import minimize", "the core imports scipy"),
        ("cameras.py", "import matplotlib.pyplot as plt", "the core imports matplotlib.pyplot"),
        ("swarm.py", "from psotrack.fitness import scene", "imports fitness of depth 6"),
        ("swarm.py", "from psotrack import cameras", "does not know cameras"),
        ("fitness.py", "import psotrack.swarm", "fitness does not know swarm"),
        ("evaluation/metrics.py", "from .. import tracker", "imports tracker of depth 8"),
        ("simulation/renderer.py", "from ..boxes import project_boxes", "simulation does not know boxes"),
        (
            "simulation/renderer.py",
            "if True:\n    from psotrack import fitness as f",
            "does not know fitness",
        ),
        ("novelty.py", "", "not in the table of depths"),
    ],
)
def test_a_planted_import_is_found(path, source, complaint):
    assert any(complaint in wrong for wrong in complaints(Path(path), source))


def test_what_is_allowed_is_not_complained_of():
    source = """
from typing import TYPE_CHECKING
import numpy as np
from psotrack import __version__, swarm
from psotrack.fitness import scene
if TYPE_CHECKING:
    import cv2
    from psotrack.pipeline import TrackSettings
"""
    assert complaints(Path("tracker.py"), source) == []
    assert (
        complaints(Path("evaluation/tables.py"), "from psotrack.evaluation.metrics import Evaluation") == []
    )


EFFECTS = """
import os, sys
import cv2, jax  # These two set variables of their own.
before = dict(os.environ)
import {module}
assert dict(os.environ) == before, "environment variables"
assert jax.config.jax_enable_x64 is False and jax.config.jax_numpy_dtype_promotion == "standard", "jax.config"
heavy = {{"matplotlib", "pandas", "pyarrow"}} & set(sys.modules)
assert not heavy, heavy
"""


def python(code, **environment):
    """Run code in a fresh interpreter, where no test has imported anything yet."""
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        check=False,
    )


@pytest.mark.parametrize("module", ["psotrack", "psotrack.cli"])
def test_importing_has_no_effects(module):
    """With a platform that does not exist, any use of a device fails: importing must not need one."""
    result = python(EFFECTS.format(module=module), JAX_PLATFORMS="nowhere")
    assert result.returncode == 0, result.stderr


def test_a_device_would_have_been_noticed():
    result = python("import jax; jax.devices()", JAX_PLATFORMS="nowhere")
    assert result.returncode != 0
    assert "nowhere" in result.stderr


def with_examples():
    return sorted(
        path.relative_to(PACKAGE.parent).with_suffix("").as_posix().replace("/", ".")
        for path in PACKAGE.rglob("*.py")
        if ">>> " in path.read_text(encoding="utf-8")
    )


@pytest.mark.parametrize("name", with_examples())
def test_examples_in_docstrings_run(name):
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0


def test_annotations_are_enforced():
    """The hook that checks shapes is on: without it these calls would be wrong silently, or fail somewhere deep."""
    rig_of_three = np.zeros((7, 2, 3))  # (points, 2, cameras) instead of (points, cameras, 2).
    with pytest.raises(jaxtyping.TypeCheckError, match="points_px"):
        triangulate(ring_rig(3).cameras, rig_of_three)
    edges = [jnp.zeros((2, 3))] * 3
    with pytest.raises(jaxtyping.TypeCheckError, match="y1"):
        # The last edge has sets and boxes swapped.
        box_sum(jnp.zeros((5, 3, 5), jnp.int32), jnp.arange(3), *edges, jnp.zeros((3, 2)))
    with pytest.raises(jaxtyping.TypeCheckError, match="tables"):
        box_sum(jnp.zeros((5, 3, 5), jnp.float32), jnp.arange(3), *edges, jnp.zeros((2, 3)))

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
from psotrack.geometry import triangulate
from psotrack.silhouettes import box_sum

PACKAGE = Path(psotrack.__file__).parent

#: The rooms of the package, lowest first: a module imports only from its own room and from lower rooms.
ROOMS = [
    "_typing",
    "errors",
    "support",
    "estimation",
    "geometry",
    "trajectories",
    "recordings",
    "datasets",
    "silhouettes",
    "settings",
    "motion",
    "detection",
    "correspondence",
    "clocks",
    "initiation",
    "tracking",
    "projection_lines",
    "fusion",
    "identity",
    "calibration",
    "doctor",
    "inside_out",
    "methods",
    "pipeline",
    "api",
    "evaluation",
    "simulation",
    "demo",
    "sweep",
    "cli",
    "__main__",
]

#: The rooms inside of `inside_out`, lowest first, in the same way.
INSIDE_OUT = [
    "camera_path",
    "lens_files",
    "marker_map",
    "frames",
    "detection",
    "pose",
    "filtering",
    "localising",
    "mapping",
    "comparison",
    "fusing",
]

#: Largest number of files at the package's root.
MOST_ROOT_FILES = 10

#: Modules and rooms that may use JAX and NumPy only.
CORE = {
    "_typing",
    "estimation",
    "geometry.boxes",
    "geometry.camera_names",
    "geometry.cameras",
    "geometry.image_fit",
    "geometry.reprojection",
    "geometry.triangulation",
    "identity.groups",
    "identity.labellings",
    "identity.likeness",
    "identity.records",
    "identity.resolving",
    "identity.settling",
    "identity.tracks",
    "motion",
    "silhouettes.summed_area",
    "tracking.fitness",
    "tracking.occlusion",
    "tracking.patches",
    "tracking.shadows",
    "tracking.sizes",
    "tracking.swarm",
    "tracking.tracker",
    "tracking.vertex",
    "trajectories.trajectories",
}
CORE_MAY_USE = {"jax", "jaxtyping", "lazy_loader", "numpy"}

#: Module or room -> modules and rooms that it must not import, although the order of rooms allows it.
STRANGERS = {
    "tracking.swarm": {"tracking.fitness", "geometry"},
    "tracking.fitness": {"tracking.swarm"},
    "simulation": {"geometry.boxes", "tracking", "silhouettes", "pipeline", "methods"},
    "evaluation": {"tracking", "geometry", "pipeline", "methods"},
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


def name_of(path):
    """The dotted name of a file relative to the package: `tracking.swarm`, `tracking` for its `__init__`."""
    return ".".join(part for part in path.with_suffix("").parts if part != "__init__")


def is_within(name, places):
    """Whether a dotted name is one of the places, or below one."""
    return any(name == place or name.startswith(f"{place}.") for place in places)


def source_of(name):
    """`geometry.Camera` is in `geometry.cameras`: where a name that a room exports comes from."""
    room, *rest = name.split(".")
    return f"{room}.{EXPORTS[room][rest[0]]}" if rest and rest[0] in EXPORTS.get(room, {}) else name


def exports():
    """Room -> name -> the module of the room that it is from, read from the rooms' `__init__.pyi`."""
    found = {}
    for stub in PACKAGE.glob("*/__init__.pyi"):
        tree = ast.parse(stub.read_text(encoding="utf-8"))
        found[stub.parent.name] = {
            alias.name: node.module
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
    return found


EXPORTS = exports()


def complaints(path, source):
    """The imports of a module, at a path relative to the package, that break the rules above."""
    me = name_of(path) or "__init__"
    room = me.split(".")[0]
    if room == "__init__":
        return []
    if room not in ROOMS:
        return [f"{path}: not in the list of rooms"]
    wrong = []
    for name in sorted(imports(source, ".".join(["psotrack", *path.parts[:-1]]))):
        top, _, rest = name.partition(".")
        if top != "psotrack":
            if is_within(me, CORE) and top not in CORE_MAY_USE and top not in sys.stdlib_module_names:
                wrong.append(f"{path}: the core imports {name}")
            continue
        other = rest.split(".")[0]
        if other not in ROOMS:
            continue
        if ROOMS.index(other) > ROOMS.index(room):
            wrong.append(f"{path}: {room} imports {other}, a higher room")
        if room == other == "inside_out":
            mine, its = (part.split(".")[1] if "." in part else "" for part in (me, rest))
            if {mine, its} <= set(INSIDE_OUT) and INSIDE_OUT.index(its) > INSIDE_OUT.index(mine):
                wrong.append(f"{path}: inside_out.{mine} imports inside_out.{its}, a higher room")
        origin = source_of(rest)
        for knower, unknown in STRANGERS.items():
            if is_within(me, {knower}) and is_within(origin, unknown):
                wrong.append(f"{path}: {knower} does not know {origin}")
        private = [part for part in rest.split(".")[1:] if part.startswith("_") and part != "__init__"]
        if private and other != room:
            wrong.append(f"{path}: {rest} is private to {other}")
    return wrong


def test_every_module_keeps_to_the_order_of_rooms():
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        wrong += complaints(path.relative_to(PACKAGE), path.read_text(encoding="utf-8"))
    assert wrong == []


def test_the_lists_name_nothing_that_is_gone():
    names = {name_of(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py")}
    listed = {*ROOMS, *CORE, *STRANGERS, *(f"inside_out.{room}" for room in INSIDE_OUT)}
    assert listed <= names
    assert {name.split(".")[0] for name in names if name} <= set(ROOMS)


def test_few_files_stand_at_the_root():
    assert len(list(PACKAGE.glob("*.py"))) <= MOST_ROOT_FILES


@pytest.mark.parametrize("room", sorted(EXPORTS))
def test_a_room_exports_what_its_stub_says(room):
    """Names are loaded when they are asked for: each of them must be there, and the room must say what it is for."""
    module = importlib.import_module(f"psotrack.{room}")
    assert set(dir(module)) >= set(EXPORTS[room])
    for name in EXPORTS[room]:
        assert getattr(module, name) is not None
    assert len(module.__doc__) > 100


@pytest.mark.parametrize(
    ("path", "source", "complaint"),
    [
        ("geometry/boxes.py", "import cv2", "the core imports cv2"),
        (
            "tracking/tracker.py",
            "def f():\n    from scipy.optimize import minimize",
            "the core imports scipy",
        ),
        ("geometry/cameras.py", "import matplotlib.pyplot as plt", "the core imports matplotlib.pyplot"),
        (
            "geometry/cameras.py",
            "from psotrack.recordings import Sequence",
            "imports recordings, a higher room",
        ),
        ("geometry/cameras.py", "from psotrack import recordings", "imports recordings, a higher room"),
        (
            "tracking/swarm.py",
            "from psotrack.tracking.fitness import camera_scores",
            "does not know tracking.fitness",
        ),
        ("tracking/swarm.py", "from psotrack.geometry import Camera", "does not know geometry.cameras"),
        ("tracking/fitness.py", "import psotrack.tracking.swarm", "does not know tracking.swarm"),
        (
            "tracking/chunks.py",
            "from psotrack.evaluation import evaluate",
            "imports evaluation, a higher room",
        ),
        (
            "evaluation/metrics.py",
            "from ..tracking import tracker",
            "evaluation does not know tracking.tracker",
        ),
        ("simulation/renderer.py", "from ..geometry import project_boxes", "does not know geometry.boxes"),
        (
            "simulation/renderer.py",
            "if True:\n    from psotrack.tracking import fitness as f",
            "does not know tracking",
        ),
        ("cli/track.py", "from psotrack.datasets._poses import read_poses", "private to datasets"),
        ("inside_out/pose/fit.py", "from psotrack.inside_out.filtering.bank import init", "a higher room"),
        ("novelty.py", "", "not in the list of rooms"),
    ],
)
def test_a_planted_import_is_found(path, source, complaint):
    assert any(complaint in wrong for wrong in complaints(Path(path), source))


def test_what_is_allowed_is_not_complained_of():
    source = """
from typing import TYPE_CHECKING
import numpy as np
from psotrack import __version__
from psotrack.tracking import swarm
from psotrack.tracking.fitness import camera_scores
if TYPE_CHECKING:
    import cv2
    from psotrack.pipeline import TrackSettings
"""
    assert complaints(Path("tracking/tracker.py"), source) == []
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

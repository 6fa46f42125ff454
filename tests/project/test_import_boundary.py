"""The order of imports between rooms, the libraries that the core may use, and the effects of importing the package.

Imports are read from the syntax tree of every module, so that imports inside functions are checked too.
"""

import ast
import doctest
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import jaxtyping
import lazy_checks
import numpy as np
import pytest
from helpers import ring_rig

import psotrack
from psotrack.foreground.silhouettes import box_sum
from psotrack.geometry import triangulate_linearly

PACKAGE = Path(psotrack.__file__).parent

#: The order of rooms, lowest first: a module imports only from its own room and from rooms before it. A room inside of
#: a room stands beside it; a module belongs to the longest name that begins its own.
ORDER = [
    "errors",
    "support",
    "geometry.estimation",
    "geometry",
    "geometry.rig_files",
    "trajectories",
    "evaluation",
    "recordings",
    "recordings.mocap",
    "recordings.datasets",
    "recordings.exchange",
    "foreground",
    "foreground.silhouettes",
    "foreground.detection",
    "foreground.markers",
    "settings",
    "tracking",
    "tracking.matching",
    "tracking.motion",
    "tracking.births",
    "tracking.swarm",
    "tracking.lines",
    "tracking.camera_errors",
    "tracking.fusion",
    "tracking.identity",
    "calibration.clocks",
    "calibration",
    "calibration.doctor",
    "inside_out.camera_path",
    "inside_out.lens_files",
    "inside_out.marker_map",
    "inside_out.frames",
    "inside_out.pose",
    "inside_out.filtering",
    "inside_out.rolling_shutter",
    "inside_out.mapping",
    "inside_out.localising",
    "inside_out.fusing",
    "inside_out",
    "pipeline",
    "pipeline.archives",
    "live",
    "simulation",
    "sweeps",
    "show",
    "show.flights",
    "show.overlay",
    "show.viewer",
    "show.reports",
    "api",
    "cli",
    "__main__",
]
#: Largest number of folders in the package.
MOST_ROOMS = 15

#: Largest number of files at the package's root.
MOST_ROOT_FILES = 6

#: Modules and rooms that may use JAX and NumPy only.
CORE = {
    "foreground.silhouettes.exposures",
    "foreground.silhouettes.summed_area",
    "geometry.boxes",
    "geometry.camera_names",
    "geometry.cameras",
    "geometry.estimation",
    "geometry.image_fit",
    "geometry.reprojection",
    "geometry.triangulation",
    "support.array_types",
    "tracking.identity.encounters",
    "tracking.identity.labellings",
    "tracking.identity.resolving",
    "tracking.motion",
    "tracking.swarm.fitness",
    "tracking.swarm.moments",
    "tracking.swarm.occlusion",
    "tracking.swarm.optimiser",
    "tracking.swarm.patches",
    "tracking.swarm.tracker",
    "tracking.swarm.vertex",
    "trajectories.trajectories",
}
CORE_MAY_USE = {"jax", "jaxtyping", "lazy_loader", "numpy"}

#: Module or room -> modules and rooms that it must not import, although the order of rooms allows it.
FORBIDDEN = {
    "tracking.swarm.optimiser": {"tracking.swarm.fitness", "geometry"},
    "tracking.swarm.fitness": {"tracking.swarm.optimiser"},
    "tracking": {"evaluation"},
    "simulation": {"geometry.boxes", "tracking", "foreground", "pipeline"},
    "evaluation": {"tracking", "geometry", "pipeline"},
}


def imports(source, package="psotrack"):
    """Set of the dotted names that a source imports when it runs; relative imports are resolved in `package`.

    For `from a import b` the set contains a.b too, because b may be a module. Imports below `if TYPE_CHECKING` are left
    out.
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


def module_name(path):
    """Dotted name of a file relative to the package: `tracking.swarm`, or `tracking` for its `__init__`."""
    return ".".join(part for part in path.with_suffix("").parts if part != "__init__")


def is_within(name, parents):
    """Whether a dotted name is one of `parents`, or below one of them."""
    return any(name == parent or name.startswith(f"{parent}.") for parent in parents)


def resolve_export(name):
    """Module that defines a name which a room exports: `geometry.Camera` -> `geometry.cameras`."""
    room, _, exported = name.rpartition(".")
    return f"{room}.{EXPORTS[room][exported]}" if exported in EXPORTS.get(room, {}) else name


def read_exports():
    """Room -> exported name -> module of the room that defines the name, read from the rooms' `__init__.pyi`."""
    found = {}
    for stub in PACKAGE.glob("*/**/__init__.pyi"):
        tree = ast.parse(stub.read_text(encoding="utf-8"))
        found[".".join(stub.relative_to(PACKAGE).parts[:-1])] = {
            alias.name: node.module
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
    return found


EXPORTS = read_exports()


def place_in_order(name):
    """Index in ORDER of the room that a module, or a name of a room, belongs to; None for the package itself."""
    rooms = [room for room in ORDER if is_within(name, {room})]
    return ORDER.index(max(rooms, key=len)) if rooms else None


def find_violations(path, source):
    """Messages for the imports of a module that break the rules above; the path is relative to the package."""
    importer = module_name(path)
    if not importer:
        return []
    place = place_in_order(importer)
    if place is None:
        return [f"{path}: not in the list of rooms"]
    wrong = []
    for name in sorted(imports(source, ".".join(["psotrack", *path.parts[:-1]]))):
        top, _, rest = name.partition(".")
        if top != "psotrack":
            if is_within(importer, CORE) and top not in CORE_MAY_USE and top not in sys.stdlib_module_names:
                wrong.append(f"{path}: the core imports {name}")
            continue
        imported = place_in_order(rest)
        if imported is None:
            continue
        if imported > place:
            wrong.append(f"{path}: {ORDER[place]} imports {ORDER[imported]}, a higher room")
        origin = resolve_export(rest)
        for part, forbidden in FORBIDDEN.items():
            if is_within(importer, {part}) and is_within(origin, forbidden):
                wrong.append(f"{path}: {part} must not import {origin}")
        private = [part for part in rest.split(".")[1:] if part.startswith("_") and part != "__init__"]
        if private and ORDER[imported] != ORDER[place]:
            wrong.append(f"{path}: {rest} is private to {ORDER[imported]}")
    return wrong


def test_every_module_obeys_the_rules_of_imports():
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        wrong += find_violations(path.relative_to(PACKAGE), path.read_text(encoding="utf-8"))
    assert wrong == []


def test_rooms_are_few_and_the_lists_have_them_all():
    names = {module_name(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py")}
    assert {*ORDER, *CORE, *FORBIDDEN} <= names
    rooms = [room.split(".")[0] for room in ORDER]
    assert {name.split(".")[0] for name in names if name} <= set(rooms)
    # The parts of a room stand together.
    assert [room for room, before in zip(rooms, [None, *rooms], strict=False) if room != before] == list(
        dict.fromkeys(rooms)
    )
    assert len({path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}) <= MOST_ROOMS
    assert len(list(PACKAGE.glob("*.py"))) <= MOST_ROOT_FILES


def test_the_architecture_page_lists_the_rooms_in_this_order():
    page = (PACKAGE.parent / "docs" / "pages" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    table = page.partition("\n## Rooms\n")[2].partition("\n## ")[0]
    assert re.findall(r"^\| `(\w+)/` \|", table, re.MULTILINE) == [
        room for room in dict.fromkeys(room.split(".")[0] for room in ORDER) if (PACKAGE / room).is_dir()
    ]


#: Folder of the tests.
TESTS = Path(__file__).parents[1]


def reaches(path, source):
    """What a file of tests imports beyond the public names of rooms; the path is relative to the folder of tests.

    The tests of a room, in the folder of its name, may import all modules of their room. No test imports a test.
    """
    names = imports(source)
    found = {name for name in names if re.match(r"test_\w+$", name)}
    for name in names:
        top, _, rest = name.partition(".")
        room, _, last = rest.rpartition(".")
        if top != "psotrack" or not room or rest in ORDER or is_within(rest, {path.parts[0]}):
            continue
        # `errors` and `settings` are modules, whose public names have no underscore.
        public = last in EXPORTS[room] if room in EXPORTS else not last.startswith("_")
        if room not in ORDER or not public:
            found.add(name)
    return sorted(found)


def test_tests_import_public_names_of_rooms_and_no_tests():
    wrong = {}
    for path in sorted(TESTS.rglob("*.py")):
        place = path.relative_to(TESTS)
        if found := reaches(place, path.read_text(encoding="utf-8")):
            wrong[place.as_posix()] = found
    assert wrong == {}


@pytest.mark.parametrize(
    ("path", "source", "count"),
    [
        (
            "cli/test_a.py",
            "from psotrack.geometry import Rig, project\nfrom psotrack.errors import InputError",
            0,
        ),
        ("cli/test_a.py", "from psotrack import cli\nimport psotrack as pt\nimport helpers", 0),
        ("geometry/test_a.py", "from psotrack.geometry.cameras import Rig", 0),
        ("cli/test_a.py", "from psotrack.geometry.cameras import Rig", 1),
        ("cli/test_a.py", "from psotrack.geometry import _camera", 1),
        ("test_a.py", "def test():\n    from test_b import world", 1),
    ],
)
def test_a_test_that_reaches_into_a_room_is_found(path, source, count):
    assert bool(reaches(Path(path), source)) == bool(count)


def public_classes(package):
    """Name of each class without a leading underscore -> the modules of the package that define such a class."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(module_name(path.relative_to(package)))
    return found


def test_no_two_public_classes_have_one_name():
    classes = public_classes(PACKAGE)
    assert len(classes) > 100
    assert {name: modules for name, modules in classes.items() if len(modules) > 1} == {}


@pytest.mark.parametrize("room", sorted(EXPORTS))
def test_a_room_exports_what_its_stub_says(room):
    """Each lazily loaded name exists, and the room has a docstring that describes it."""
    module = importlib.import_module(f"psotrack.{room}")
    assert set(dir(module)) >= set(EXPORTS[room])
    for name in EXPORTS[room]:
        assert getattr(module, name) is not None
    assert len(module.__doc__) > 100


#: Path of a module, its source, and part of the complaint.
FOUND = [
    ("geometry/boxes.py", "import cv2", "the core imports cv2"),
    (
        "tracking/swarm/tracker.py",
        "def f():\n    from scipy.optimize import minimize",
        "the core imports scipy",
    ),
    ("geometry/cameras.py", "from psotrack import recordings", "imports recordings, a higher room"),
    (
        "tracking/motion/kalman.py",
        "from psotrack.tracking import lines",
        "tracking.motion imports tracking.lines",
    ),
    (
        "tracking/swarm/optimiser.py",
        "from psotrack.geometry import Camera",
        "must not import geometry.cameras",
    ),
    (
        "evaluation/metrics.py",
        "from ..tracking.swarm import tracker",
        "evaluation must not import tracking.swarm",
    ),
    (
        "simulation/renderer.py",
        "if True:\n    from psotrack.tracking.swarm import fitness as f",
        "must not import tracking",
    ),
    (
        "cli/track.py",
        "from psotrack.recordings.datasets._poses import read_poses",
        "private to recordings.datasets",
    ),
    ("novelty.py", "", "not in the list of rooms"),
]


@pytest.mark.parametrize(("path", "source", "message"), FOUND)
def test_a_forbidden_import_is_found(path, source, message):
    assert any(message in wrong for wrong in find_violations(Path(path), source))


def test_allowed_imports_give_no_message():
    source = """
from typing import TYPE_CHECKING
import numpy as np
from psotrack import __version__
from psotrack.tracking.swarm import optimiser
from psotrack.tracking.swarm.fitness import camera_scores
if TYPE_CHECKING:
    import cv2
    from psotrack.pipeline import TrackSettings
"""
    assert find_violations(Path("tracking/swarm/tracker.py"), source) == []
    assert (
        find_violations(Path("evaluation/tables.py"), "from psotrack.evaluation.metrics import Evaluation")
        == []
    )


EFFECTS = """
import os, sys
import cv2, jax  # These two libraries set environment variables.
before = dict(os.environ)
import {module}
assert dict(os.environ) == before, "environment variables"
assert jax.config.jax_enable_x64 is False and jax.config.jax_numpy_dtype_promotion == "standard", "jax.config"
heavy = {{"matplotlib", "pandas", "pyarrow"}} & set(sys.modules)
assert not heavy, heavy
"""


@pytest.mark.parametrize(
    ("code", "fails"),
    [
        (EFFECTS.format(module="psotrack"), False),
        (EFFECTS.format(module="psotrack.cli"), False),
        ("import jax; jax.devices()", True),
    ],
    ids=["psotrack", "psotrack.cli", "a device is used"],
)
def test_importing_has_no_effects(code, fails):
    """With a JAX platform that does not exist, any use of a device fails; importing must not use a device."""
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"JAX_PLATFORMS": "nowhere"},
        check=False,
    )
    assert bool(result.returncode) == fails, result.stderr


def modules_with_examples():
    return sorted(
        path.relative_to(PACKAGE.parent).with_suffix("").as_posix().replace("/", ".")
        for path in PACKAGE.rglob("*.py")
        if ">>> " in path.read_text(encoding="utf-8")
    )


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_in_docstrings_run(name):
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.skipif(os.environ.get("PSOTRACK_TYPE_CHECKS") != "on", reason="`make nightly` checks types")
@lazy_checks.all_calls_checked()
def test_annotations_are_enforced():
    """The hook that checks shapes is active: without it, wrong shapes give wrong results or errors deep in the code."""
    swapped_axes = np.zeros((7, 2, 3))  # (points, 2, cameras) instead of (points, cameras, 2).
    with pytest.raises(jaxtyping.TypeCheckError, match="points_px"):
        triangulate_linearly(ring_rig(3).cameras, swapped_axes)
    edges = [jnp.zeros((2, 3))] * 3
    with pytest.raises(jaxtyping.TypeCheckError, match="y1"):
        # The axes of the last edge are swapped.
        box_sum(jnp.zeros((5, 3, 5), jnp.int32), jnp.arange(3), *edges, jnp.zeros((3, 2)))
    with pytest.raises(jaxtyping.TypeCheckError, match="tables"):
        box_sum(jnp.zeros((5, 3, 5), jnp.float32), jnp.arange(3), *edges, jnp.zeros((2, 3)))

"""The order of imports between rooms, the libraries that the core may use, and the effects of importing the package.

Imports are read from the syntax tree of every module, so that imports inside functions are checked too.
"""

import ast
import doctest
import functools
import importlib
import os
import re
import subprocess
import sys
from collections import defaultdict
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
from helpers import ring_rig

import psotrack
from psotrack.geometry import triangulate_linearly

PACKAGE = Path(psotrack.__file__).parent
#: Folder of the tests.
TESTS = Path(__file__).parents[1]
ARCHITECTURE = PACKAGE.parent / "docs" / "pages" / "explanation" / "architecture.md"
#: Path of a module relative to the package -> its source.
SOURCES = {
    path.relative_to(PACKAGE): path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))
}
#: Largest number of folders in the package, and of files at its root.
MOST_ROOMS, MOST_ROOT_FILES = 15, 6

#: Modules and rooms that may use JAX and NumPy only, beside all modules that use JAX.
CORE = {
    "geometry",
    "geometry.estimation",
    "tracking.identity",
    "tracking.lines",
    "tracking.motion",
    "tracking.swarm",
    "trajectories.trajectories",
}
CORE_MAY_USE = {"equinox", "jax", "jaxtyping", "lazy_loader", "numpy", "optax"}
#: Module of the core -> another library that it may use.
EXCEPTIONS = {"geometry.rotations": "scipy", "pipeline.results": "msgspec"}

#: Module or room -> modules and rooms that it must not import, although the order of rooms allows it.
FORBIDDEN = {
    "tracking.swarm.optimiser": {"tracking.swarm.fitness", "geometry"},
    "tracking.swarm.fitness": {"tracking.swarm.optimiser"},
    "tracking": {"evaluation"},
    "simulation": {"geometry.boxes", "tracking", "foreground", "pipeline"},
    "evaluation": {"tracking", "geometry", "pipeline"},
}


def module_name(path):
    """Dotted name of a file relative to the package: `tracking.swarm`, or `tracking` for its `__init__`."""
    return ".".join(part for part in path.with_suffix("").parts if part != "__init__")


_page = ARCHITECTURE.read_text(encoding="utf-8")
_table, _, _rest = _page.partition("\n## Rooms\n")[2].partition("\nInside of `tracking/`")
_inside = re.findall(r"`(\w+)`\s\(", _rest.partition("\n\n")[0])
#: Order of rooms, lowest first: those of the package by the table of the architecture page, then tracking's.
ORDERS = re.findall(r"^\| `(\w+)/` \|", _table, re.MULTILINE), [f"tracking.{room}" for room in _inside]


@functools.cache
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


def is_within(name, parents):
    """Whether a dotted name is one of `parents`, or below one of them."""
    return any(name == parent or name.startswith(f"{parent}.") for parent in parents)


def place_in(order, name):
    """Place of the room that a module, or a name of a room, belongs to; None if it belongs to none of them."""
    return next((place for place, room in enumerate(order) if is_within(name, {room})), None)


#: Room -> exported name -> module of the room that defines the name, read from the rooms' `__init__.pyi`.
EXPORTS = {}
for _stub in PACKAGE.glob("*/**/__init__.pyi"):
    _own = EXPORTS[".".join(_stub.relative_to(PACKAGE).parts[:-1])] = {}
    for _node in ast.parse(_stub.read_text(encoding="utf-8")).body:
        if isinstance(_node, ast.ImportFrom):
            _own |= {alias.name: _node.module for alias in _node.names}
#: The rooms with public names, and what is at the root; a module belongs to the longest name that begins its own.
ROOMS = {*EXPORTS, *(module_name(path).partition(".")[0] for path in SOURCES)} - {""}


def room_of(name):
    """The room that a module, or a name of a room, belongs to; None for the package itself."""
    return max((room for room in ROOMS if is_within(name, {room})), key=len, default=None)


def find_violations(path, source):
    """Messages for the imports of a module that break the rules above; the path is relative to the package."""
    importer = module_name(path)
    own = room_of(importer)
    names = imports(source, ".".join(["psotrack", *path.parts[:-1]]))
    libraries = {name.partition(".")[0] for name in names} - {"psotrack", *sys.stdlib_module_names}
    wrong = []
    if {own, importer} & CORE or "jax" in libraries:
        foreign = libraries - CORE_MAY_USE - {EXCEPTIONS.get(importer)}
        wrong += [f"{path}: the core imports {name}" for name in sorted(foreign)]
    for name in sorted(name.removeprefix("psotrack.") for name in names if name.startswith("psotrack.")):
        for order in ORDERS:
            places = [place_in(order, importer), place_in(order, name)]
            if None not in places and places[0] < places[1]:
                wrong.append(f"{path}: imports {order[places[1]]}, a higher room")
        # `geometry.Camera` is defined in `geometry.cameras`.
        exporter, _, exported = name.rpartition(".")
        module = EXPORTS.get(exporter, {}).get(exported)
        origin = f"{exporter}.{module}" if module else name
        for part, forbidden in FORBIDDEN.items():
            if is_within(importer, {part}) and is_within(origin, forbidden):
                wrong.append(f"{path}: {part} must not import {origin}")
        if room_of(name) != own and re.search(r"\._(?!_)", name):
            wrong.append(f"{path}: {name} is private to {room_of(name)}")
    return wrong


def imported_rooms(sources):
    """Room -> other rooms that its modules import."""
    graph = defaultdict(set)
    for path, source in sources.items():
        own = room_of(module_name(path))
        names = imports(source, ".".join(["psotrack", *path.parts[:-1]]))
        inside = [name.removeprefix("psotrack.") for name in names if name.startswith("psotrack.")]
        graph[own] |= {room_of(name) for name in inside} - {own, None}
    return graph


def test_every_module_obeys_the_rules_of_imports():
    for path, source in SOURCES.items():
        assert find_violations(path, source) == []


def test_no_rooms_import_each_other_in_a_circle():
    graph = imported_rooms({path: source for path, source in SOURCES.items() if module_name(path)})
    TopologicalSorter(graph).prepare()
    circle = {
        Path("inside_out/pose/a.py"): "from psotrack.inside_out.filtering import b",
        Path("inside_out/filtering/b.py"): "from ..pose import a",
    }
    with pytest.raises(CycleError):
        TopologicalSorter(imported_rooms(circle)).prepare()


def test_rooms_are_few_and_the_lists_name_what_is_there():
    names = set(map(module_name, SOURCES))
    assert {*CORE, *EXCEPTIONS, *FORBIDDEN} <= names
    assert sorted(ORDERS[0]) == sorted(room for room in ROOMS if (PACKAGE / room).is_dir())
    assert sorted(ORDERS[1]) == sorted(name for name in names if re.fullmatch(r"tracking\.\w+", name))
    assert len(ORDERS[0]) <= MOST_ROOMS
    assert len(list(PACKAGE.glob("*.py"))) <= MOST_ROOT_FILES


#: Path of a module, its source, and part of the complaint.
FOUND = [
    ("geometry/boxes.py", "import cv2", "the core imports cv2"),
    ("support/devices.py", "def f():\n    import pandas\n    import jax", "the core imports pandas"),
    ("geometry/cameras.py", "from psotrack import recordings", "imports recordings, a higher room"),
    ("tracking/motion/kalman.py", "from psotrack.tracking import lines", "imports tracking.lines, a higher"),
    ("tracking/swarm/optimiser.py", "from psotrack.geometry import Camera", "import geometry.cameras"),
    ("evaluation/metrics.py", "from ..geometry import boxes", "evaluation must not import geometry.boxes"),
    ("cli/track.py", "from psotrack.recordings.datasets._a import b", "private to recordings.datasets"),
]


@pytest.mark.parametrize(("path", "source", "message"), FOUND)
def test_a_forbidden_import_is_found(path, source, message):
    assert any(message in wrong for wrong in find_violations(Path(path), source))


def reaches(path, source):
    """What a file of tests imports beyond the public names of rooms; the path is relative to the folder of tests.

    The tests of a room, in the folder of its name, may import all modules of their room. No test imports a test.
    """
    names = imports(source)
    found = {name for name in names if re.match(r"test_\w+$", name)}
    for name in names:
        top, _, rest = name.partition(".")
        room, _, last = rest.rpartition(".")
        if top != "psotrack" or not room or rest in ROOMS or is_within(rest, {path.parts[0]}):
            continue
        # `errors` and `settings` are modules, whose public names have no underscore.
        public = last in EXPORTS[room] if room in EXPORTS else not last.startswith("_")
        if room not in ROOMS or not public:
            found.add(name)
    return sorted(found)


def test_tests_import_public_names_of_rooms_and_no_tests():
    for path in sorted(TESTS.rglob("*.py")):
        assert reaches(path.relative_to(TESTS), path.read_text(encoding="utf-8")) == [], path


@pytest.mark.parametrize("room", sorted(EXPORTS))
def test_a_room_exports_what_its_stub_says(room):
    """Each lazily loaded name exists, and the room has a docstring that describes it."""
    module = importlib.import_module(f"psotrack.{room}")
    assert set(dir(module)) >= set(EXPORTS[room])
    for name in EXPORTS[room]:
        assert getattr(module, name) is not None
    assert len(module.__doc__) > 100


#: Importing the package, and its commands after the two libraries that set environment variables.
EFFECTS = """
import os, sys
before = dict(os.environ)
import psotrack as pt
assert len(dir(pt)) > 30
heavy = {"jax", "cv2", "pandas", "zarr", "scipy", "numpy"} & set(sys.modules)
assert not heavy and dict(os.environ) == before, heavy
import cv2, jax
before = dict(os.environ)
import psotrack.cli
assert dict(os.environ) == before, "environment variables"
assert jax.config.jax_enable_x64 is False and jax.config.jax_numpy_dtype_promotion == "standard", "jax.config"
heavy = {"matplotlib", "pandas", "pyarrow"} & set(sys.modules)
assert not heavy, heavy
print("no effects")
jax.devices()
"""


def test_importing_has_no_effects_and_loads_nothing_heavy():
    """With a JAX platform that does not exist, any use of a device fails, as the last line does."""
    command, environment = [sys.executable, "-c", EFFECTS], os.environ | {"JAX_PLATFORMS": "nowhere"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert (result.returncode, result.stdout) == (1, "no effects\n"), result.stderr


@pytest.mark.parametrize("name", [module_name(path) for path, source in SOURCES.items() if ">>> " in source])
def test_examples_in_docstrings_run(name):
    module = importlib.import_module(f"psotrack.{name}")
    result = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.skipif(os.environ.get("PSOTRACK_TYPE_CHECKS") != "on", reason="`make nightly` checks types")
def test_annotations_are_enforced():
    """The hook that checks shapes is active: without it, wrong shapes give wrong results or errors deep in the code."""
    swapped_axes = np.zeros((7, 2, 3))  # (points, 2, cameras) instead of (points, cameras, 2).
    with pytest.raises(jaxtyping.TypeCheckError, match="points_px"):
        triangulate_linearly(ring_rig(3).cameras, swapped_axes)

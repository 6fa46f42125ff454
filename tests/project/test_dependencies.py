"""What pyproject.toml declares is imported, and what is imported is declared."""

import ast
import functools
import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
#: Names of imports that are not those of their distributions.
IMPORT_NAMES = {
    "mcap-ros2-support": "mcap_ros2",
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "rerun-sdk": "rerun",
}
#: Part of a declared distribution: jax, jinja2, matplotlib; and IPython is there where a notebook shows a result.
NOT_DECLARED = {"markupsafe", "IPython"}
#: Functions that import the module whose name they are given.
IMPORTERS = {"import_module", "_library"}


def declared(extra: str) -> set[str]:
    """Names of the imports that an extra, or "dependencies", declares."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = {"dependencies": project["dependencies"], **project["optional-dependencies"]}[extra]
    distributions = [re.match(r"[\w.-]+", requirement)[0] for requirement in requirements]
    return {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in distributions}


@functools.cache
def imported(folder: str) -> frozenset[str]:
    """First parts of the names of all modules that the files below a folder import, also inside functions."""
    found: set[str] = set()
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add(node.module)
            elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in IMPORTERS:
                found.update(given.value for given in node.args if isinstance(given, ast.Constant))
    return frozenset(name.split(".")[0] for name in found)


#: Extras of the package.
EXTRAS = ("control", "live", "view", "ros", "onnx", "dask")


def test_what_is_declared_is_imported() -> None:
    assert declared("dependencies") <= imported("psotrack")
    assert {extra: unused for extra in EXTRAS if (unused := declared(extra) - imported("psotrack"))} == {}


def test_what_is_imported_is_declared() -> None:
    known = {"psotrack", *sys.stdlib_module_names}.union(*map(declared, ("dependencies", *EXTRAS)))
    assert imported("psotrack") - known == NOT_DECLARED

"""Names in the file of a grid: the allowed names of each table, and the place of each value in the file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from psotrack.errors import SettingsError
from psotrack.settings import flatten, setting_names
from psotrack.support import nearest
from psotrack.sweep.cells import Perturbation

#: Dotted names that the tables [settings] and [methods.NAME] may contain.
SETTINGS = tuple(name for name in setting_names() if name != "seed")
#: Names of the perturbations that [grid] may vary.
PERTURBATIONS = tuple(name for name in Perturbation.__struct_fields__ if name != "draw")

#: Names that [grid] may vary in addition to the settings.
INPUTS = ("cameras", "frames", *PERTURBATIONS)


def table(where: str, place: str, content: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Values of a table, by dotted name.

    Args:
        where: beginning of error messages, such as the file's path.
        place: name of the table in the file.
        content: the table; its names are dotted, or lead to inner tables.
        names: allowed names.

    Raises:
        SettingsError: `content` is not a table, a name is not allowed, or a name occurs twice.
    """
    if not isinstance(content, Mapping):
        raise SettingsError(f"{where}: {place}", expected="a table", found=f"{content!r}")
    values: dict[str, Any] = {}
    for name, value in flatten(content):
        check_name(f"{where}: {place}.", name, names)
        if name in values:
            raise SettingsError(f"{where}: {place}.{name}", expected="the name once", found="the name twice")
        values[name] = value
    return values


def check_name(prefix: str, name: str, names: tuple[str, ...]) -> None:
    """Raise `SettingsError` if a name is not allowed; the error suggests a name.

    Args:
        prefix: beginning of the error message: the file and the table.
        name: the name.
        names: allowed names.
    """
    if name in names:
        return
    if any(other.startswith(f"{name}.") for other in names):
        raise SettingsError(f"{prefix}{name}", expected="a table with names", found="none")
    near = nearest(name, names)
    if name == "seed":
        remedy = "every run has a seed of its own: set runs = 10, and first_seed if the first seed is not 0"
    elif name in INPUTS:
        remedy = "it belongs in [grid], with a list of values"
    elif name in SETTINGS:
        remedy = "it belongs in [settings], or in [grid] with a list of values"
    else:
        remedy = f"did you mean {near}?" if near else f"allowed names are {', '.join(names)}"
    raise SettingsError(f"{prefix}{name}", expected="an allowed name", found=name, remedy=remedy)


def nest(values: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Nested tables from dotted names and values; dotted names that are not among `names` are left out."""
    data: dict[str, Any] = {}
    for name, value in values.items():
        if name in names:
            *outer, last = name.split(".")
            inner = data
            for part in outer:
                inner = inner.setdefault(part, {})
            inner[last] = value
    return data


def place_of(field: str, places: Mapping[str, str]) -> str:
    """Place in the file of a field of a record.

    Args:
        field: dotted name of the field, or the name's last part, followed by the index of an item if it has one.
        places: places in the file, by dotted name.
    """
    name, bracket, item = field.partition("[")
    for dotted, place in places.items():
        if name in (dotted, dotted.rpartition(".")[2]):
            return f"{place}{bracket}{item}"
    # The file does not contain the field: a value in the file does not fit the field's default.
    return f"the default of {field}"

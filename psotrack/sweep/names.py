"""The names in a grid: which there are, where each belongs, and where in the file a value was written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from psotrack.errors import SettingsError
from psotrack.settings import renamed, setting_names
from psotrack.support import nearest
from psotrack.sweep.cells import Perturbation

#: Dotted names of everything that [settings] and [methods] may set.
SETTINGS = tuple(name for name in setting_names() if name != "seed")
PERTURBATIONS = tuple(name for name in Perturbation.__struct_fields__ if name != "draw")

#: What [grid] may vary besides.
INPUTS = ("cameras", "frames", *PERTURBATIONS)


def table(where: str, place: str, content: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Dotted names -> values of a table.

    Args:
        where: what messages begin with.
        place: of the table in the file.
        content: dotted names, or tables in tables.
        names: that it may have.

    Raises:
        SettingsError: it is no table, or has another name, or one twice.
    """
    if not isinstance(content, Mapping):
        raise SettingsError(f"{where}: {place}", expected="a table", found=f"{content!r}")
    values: dict[str, Any] = {}
    for name, value in flat(content):
        check_name(f"{where}: {place}.", name, names)
        if name in values:
            raise SettingsError(f"{where}: {place}.{name}", expected="it once", found="it twice")
        values[name] = value
    return values


def check_name(prefix: str, name: str, names: tuple[str, ...]) -> None:
    """Raise `SettingsError` unless the name is one of those; it says what may be meant."""
    if name in names:
        return
    if renamed(name):
        raise SettingsError(
            f"{prefix}{name}", expected="a name that there is", found=name, remedy=renamed(name)
        )
    if any(other.startswith(f"{name}.") for other in names):
        raise SettingsError(f"{prefix}{name}", expected="a table with names", found="none")
    near = nearest(name, names)
    if name == "seed":
        remedy = "runs are seeds: say runs = 10, and first_seed where they shall not begin with 0"
    elif name in INPUTS:
        remedy = "it belongs in [grid], with a list of values"
    elif name in SETTINGS:
        remedy = "it belongs in [settings], or in [grid] with a list of values"
    else:
        remedy = f"did you mean {near}?" if near else f"there are {', '.join(names)}"
    raise SettingsError(f"{prefix}{name}", expected="a name that there is", found=name, remedy=remedy)


def flat(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values; an empty table is a value."""
    for name, value in content.items():
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def nested(values: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Tables in tables, of those dotted names that are among `names`."""
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
    """Where in the file a field of a record was written, which may be an item of it, or its last name only."""
    name, bracket, item = field.partition("[")
    for dotted, place in places.items():
        if name in (dotted, dotted.rpartition(".")[2]):
            return f"{place}{bracket}{item}"
    # What was written does not go with the default of this.
    return f"the default of {field}"

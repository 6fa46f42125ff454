"""Grids: sequences, settings and values to vary, from a TOML file or a mapping, and the cells of a grid.

A grid and the settings of all its cells are checked when the grid is read, before any cell runs. Errors name the place
in the file, such as `grid.swarm.particles[1]`.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from psotrack.errors import SettingsError, errors_name
from psotrack.foreground.silhouettes import check_whole
from psotrack.settings import TrackSettings, flatten, setting_names
from psotrack.support import assign, convert, did_you_mean, read_toml
from psotrack.sweeps.cells import Cell, Perturbation, cameras_label

#: Dotted names that the tables [settings] and [methods.NAME] may contain.
SETTINGS = tuple(name for name in setting_names() if name != "seed")
#: Names of the perturbations that [grid] may vary.
PERTURBATIONS = tuple(name for name in Perturbation.__struct_fields__ if name != "draw")

#: Names that [grid] may vary in addition to the settings.
INPUTS = ("cameras", "frames", *PERTURBATIONS)


#: A value of a cell: place in the file, dotted name, and the value as it is in the file.
_Choice = tuple[str, str, Any]


@dataclass(frozen=True)
class Grid:
    """A grid whose names are checked; `dataclasses.replace` makes a changed grid.

    Attributes:
        sequences: folders, or names under the data's root.
        runs: number of runs of every cell.
        first_seed: seed of a cell's first run; the following runs have the following seeds.
        settings: values of all cells, by dotted name.
        methods: for each method, by name, values that replace values of `settings`, by dotted name.
        axes: lists of values, by dotted name; every combination of values is a cell.
        draws: number of random draws for cells that depend on random numbers; None is a single draw.
        where: beginning of error messages, such as the file's path.
    """

    sequences: tuple[str, ...]
    runs: int
    first_seed: int
    settings: Mapping[str, Any]
    methods: Mapping[str, Mapping[str, Any]]
    axes: Mapping[str, tuple[Any, ...]]
    draws: int | None
    where: str

    def cells(self) -> tuple[Cell, ...]:
        """All cells, in the order of the file: by sequence, method, axes and draw.

        Raises:
            SettingsError: a value is not allowed, or two cells are the same; the message names the place in the file.
        """
        options = [
            [(f"grid.{name}[{index}]", name, value) for index, value in enumerate(values)]
            for name, values in self.axes.items()
        ]
        sequences = [(f"sequences[{index}]", sequence) for index, sequence in enumerate(self.sequences)]
        combinations = itertools.product(sequences, self.methods or ("",), [*itertools.product(*options)])
        placed = []
        for (place, sequence), method, choices in combinations:
            cell = replace(self._cell(method, choices), sequence=sequence)
            # A combination that uses no random numbers has one cell.
            for draw in range(self.draws or 1) if cell.is_random else (0,):
                perturbation = msgspec.structs.replace(cell.perturbation, draw=draw)
                axes = cell.axes if self.draws is None else {**cell.axes, "draw": draw}
                places = (place, f"methods.{method}", *(place for place, _, _ in choices))
                placed.append((places, replace(cell, perturbation=perturbation, axes=axes)))
        self._check_different(placed)
        if self.draws is not None and not any(cell.is_random for _, cell in placed):
            expected = f"a random choice in [grid]: a number of cameras, {', '.join(PERTURBATIONS)}"
            raise self._error("grid.draws", expected=expected, found="none")
        return tuple(cell for _, cell in placed)

    def _cell(self, method: str, choices: tuple[_Choice, ...]) -> Cell:
        own = self.methods.get(method, {})
        given: tuple[_Choice, ...] = (
            *((f"settings.{name}", name, value) for name, value in self.settings.items()),
            *((f"methods.{method}.{name}", name, value) for name, value in own.items()),
            *choices,
        )
        places = {name: place for place, name, _ in given}
        values = {name: value for _, name, value in given}
        settings = self._record(TrackSettings, _nest(values, SETTINGS), places)
        perturbation = self._record(Perturbation, _nest(values, PERTURBATIONS), places)
        if settings.reads_detections:
            # These perturbations change silhouettes, and would have no effect on detections.
            for name in ("clock_frames", "flipped"):
                if getattr(perturbation, name):
                    expected = "0 for a method that reads detections, because it changes silhouettes only"
                    raise self._error(places[name], expected=expected, found=f"{values[name]}")
        cameras, frames = self._cameras(values, places), values.get("frames")
        if frames is not None:
            check_whole(f"{self.where}: {places['frames']}", frames, lowest=1)
        every = dict(flatten(msgspec.to_builtins(settings))) | msgspec.to_builtins(perturbation)
        every |= {"cameras": cameras_label(cameras), "frames": frames}
        axes = {name: every[name] for name in self.axes}
        return Cell("", method, cameras, frames, perturbation, settings, self.runs, axes, self.first_seed)

    def _record(self, kind: type[msgspec.Struct], data: dict[str, Any], places: Mapping[str, str]) -> Any:
        """A checked record; errors name the place of the wrong value in the file."""
        try:
            return convert(data, kind, error=SettingsError)
        except SettingsError as fault:
            # The error names the field, perhaps by its last part only, but not the field's place in the file.
            field, _, sentence = str(fault).partition(": expected ")
            expected, _, found = sentence.partition(", found ")
            raise self._error(_place_of(field, places), expected=expected, found=found) from None

    def _cameras(self, values: Mapping[str, Any], places: Mapping[str, str]) -> tuple[str, ...] | int | None:
        value = values.get("cameras", "all")
        if value == "all":
            return None
        if isinstance(value, int) and not isinstance(value, bool) and value > 0:
            return value
        names = tuple(value) if isinstance(value, list | tuple) else ()
        words = all(isinstance(name, str) and name for name in names)
        if not (names and words and len(set(names)) == len(names)):
            expected = '"all", a number above 0, or a list of different names'
            raise self._error(places["cameras"], expected=expected, found=f"{value!r}")
        return names

    def _check_different(self, placed: list[tuple[tuple[str, ...], Cell]]) -> None:
        seen: dict[Any, tuple[str, ...]] = {}
        for places, cell in placed:
            made_of = (cell.sequence, cell.cameras, cell.frames, cell.perturbation, cell.settings)
            first = seen.setdefault(made_of, places)
            if first is not places:
                pairs = [(one, other) for one, other in zip(places, first, strict=True) if one != other]
                here, there = (" and ".join(names) for names in zip(*pairs, strict=True))
                raise self._error(here, expected="cells that differ", found=f"the same cell as with {there}")

    def _error(self, place: str, *, expected: str, found: str) -> SettingsError:
        return SettingsError(f"{self.where}: {place}", expected=expected, found=found)


class _File(msgspec.Struct, frozen=True, kw_only=True):
    """Content of a grid's file; each table is checked separately."""

    sequences: Annotated[tuple[Annotated[str, msgspec.Meta(min_length=1)], ...], msgspec.Meta(min_length=1)]
    runs: Annotated[int, msgspec.Meta(ge=1)] = 1
    first_seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    settings: dict[str, Any] = {}
    methods: dict[str, Any] = {}
    grid: dict[str, Any] = {}


def read_grid(path: Path) -> Grid:
    """Read a grid from a TOML file.

    Raises:
        InputError: the file cannot be read, or is not TOML.
        SettingsError: a name or value is wrong; the message says its place in the file, and the nearest allowed name.
    """
    return grid(read_toml(path), where=str(path))


def grid(mapping: Mapping[str, Any], where: str = "grid") -> Grid:
    """Make a grid from a mapping with the same content as a TOML file.

    Args:
        mapping: `sequences`, `runs`, `first_seed`, `settings`, `methods` and `grid`; names of settings are dotted, or
            lead to inner mappings.
        where: beginning of error messages, such as the file's path.

    Raises:
        SettingsError: a name or value is wrong; the message says its place, and the nearest allowed name.

    Example:
        >>> axes = {"swarm.particles": [20, 50], "silhouettes.reduction": [4]}
        >>> varied = grid({"sequences": ["S01"], "grid": axes})
        >>> [dict(cell.axes) for cell in varied.cells()]
        [{'swarm.particles': 20, 'silhouettes.reduction': 4}, {'swarm.particles': 50, 'silhouettes.reduction': 4}]
    """
    for name in mapping:
        _check_name(f"{where}: ", name, _File.__struct_fields__)
    data = dict(mapping)
    if isinstance(data.get("sequences"), list | tuple):
        data["sequences"] = [os.fspath(one) if isinstance(one, Path) else one for one in data["sequences"]]
    file: _File = convert(data, _File, f"{where}: ", SettingsError)
    with errors_name(f"{where}: first_seed, last run"):
        TrackSettings(seed=file.first_seed + file.runs - 1)
    settings = _table(where, "settings", file.settings, SETTINGS)
    methods = {
        name: _table(where, f"methods.{name}", content, SETTINGS) for name, content in file.methods.items()
    }
    axes = _table(where, "grid", file.grid, (*SETTINGS, *INPUTS, "draws"))
    draws = axes.pop("draws", None)
    if draws is not None:
        check_whole(f"{where}: grid.draws", draws, lowest=1)
    for name, values in axes.items():
        if not isinstance(values, list | tuple) or not values:
            remedy = "" if isinstance(values, list | tuple | dict) else f"write [{values}]"
            expected, found = "a list of values", f"{values!r}"
            raise SettingsError(f"{where}: grid.{name}", expected=expected, found=found, remedy=remedy)
        for place, set_there in (("settings", settings), *((f"methods.{of}", methods[of]) for of in methods)):
            if name in set_there:
                found = f"{place}.{name} as well"
                raise SettingsError(f"{where}: grid.{name}", expected="the name in one place", found=found)
    checked = Grid(
        file.sequences,
        file.runs,
        file.first_seed,
        settings,
        methods,
        {name: tuple(values) for name, values in axes.items()},
        draws,
        where,
    )
    checked.cells()
    return checked


def _table(where: str, place: str, content: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Values of the table at a place in the file by dotted name; its names are dotted, or lead to inner tables."""
    if not isinstance(content, Mapping):
        raise SettingsError(f"{where}: {place}", expected="a table", found=f"{content!r}")
    values: dict[str, Any] = {}
    for name, value in flatten(content):
        _check_name(f"{where}: {place}.", name, names)
        if name in values:
            raise SettingsError(f"{where}: {place}.{name}", expected="the name once", found="the name twice")
        values[name] = value
    return values


def _check_name(prefix: str, name: str, names: tuple[str, ...]) -> None:
    """Raise `SettingsError`, which suggests a name, if a name is not allowed; `prefix` begins the message."""
    if name in names:
        return
    if any(other.startswith(f"{name}.") for other in names):
        raise SettingsError(f"{prefix}{name}", expected="a table with names", found="none")
    if name == "seed":
        remedy = "every run has a seed of its own: set runs = 10, and first_seed if the first seed is not 0"
    elif name in INPUTS:
        remedy = "it belongs in [grid], with a list of values"
    elif name in SETTINGS:
        remedy = "it belongs in [settings], or in [grid] with a list of values"
    else:
        remedy = did_you_mean(name, names) or f"allowed names are {', '.join(names)}"
    raise SettingsError(f"{prefix}{name}", expected="an allowed name", found=name, remedy=remedy)


def _nest(values: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Nested tables from dotted names and values; dotted names that are not among `names` are left out."""
    data: dict[str, Any] = {}
    for name in values.keys() & set(names):
        assign(data, name, values[name])
    return data


def _place_of(field: str, places: Mapping[str, str]) -> str:
    """Place in the file of a field of a record: its dotted name or its last part, perhaps with the index of an item."""
    name, bracket, item = field.partition("[")
    for dotted, place in places.items():
        if name in (dotted, dotted.rpartition(".")[2]):
            return f"{place}{bracket}{item}"
    # The file does not contain the field: a value in the file does not fit the field's default.
    return f"the default of {field}"

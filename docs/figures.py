"""Figures that the pages and the README show, taken from experiments/results.

Pages call these functions in Jinja expressions, for instance `{{ mean("ablation", "mean_error_m") | mm }}`.
A result, a column or a row that is missing raises `MissingFigureError`, which stops the build.
"""

from __future__ import annotations

import inspect
import json
import sys
import tomllib
from collections.abc import Iterator
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import click
import msgspec
import pandas as pd
from griffe import Docstring, DocstringSectionKind
from jinja2 import Environment, StrictUndefined

#: Functions of the pages that are statistics of a column, and the names of these in pandas.
STATISTICS = {"mean": "mean", "total": "sum", "least": "min", "most": "max"}
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import _results  # noqa: E402
from griffe_examples import split_shared_items  # noqa: E402

from psotrack.settings import TrackSettings  # noqa: E402


class MissingFigureError(Exception):
    """A result file does not hold the figure that a page shows."""


@cache
def record(name: str) -> dict[str, Any]:
    """The record of a figure."""
    path = _results.FOLDER / f"{name}.json"
    if not path.exists():
        raise MissingFigureError(f"{path}: expected a record, found none; run `make results ONLY={name}`")
    return json.loads(path.read_text(encoding="utf-8"))


@cache
def all_rows(name: str) -> pd.DataFrame:
    """All rows of a figure."""
    path = _results.FOLDER / f"{name}.csv"
    if not path.exists():
        raise MissingFigureError(f"{path}: expected rows, found none; run `make results ONLY={name}`")
    return pd.read_csv(path)


def rows(name: str, /, **where: Any) -> pd.DataFrame:
    """Rows of a result whose columns have the given values.

    Args:
        name: name of the figure in experiments/results.toml.
        where: values that columns must have; a list allows several values.
    """
    table = all_rows(name)
    for column, value in where.items():
        if column not in table:
            raise MissingFigureError(f"{name}: expected a column {column}, found {', '.join(table.columns)}")
        table = table[table[column].isin(value if isinstance(value, list) else [value])]
    if table.empty:
        raise MissingFigureError(f"{name}: expected rows with {where}, found none")
    return table


def column(name: str, value: str, /, **where: Any) -> pd.Series:
    """One column of the rows of a result."""
    table = rows(name, **where)
    if value not in table:
        raise MissingFigureError(f"{name}: expected a column {value}, found {', '.join(table.columns)}")
    return table[value]


def statistic(how: str, name: str, value: str, /, **where: Any) -> float:
    """Mean, sum, smallest or largest value of a column over the rows of a result."""
    return float(getattr(column(name, value, **where), how)())


def figure(name: str, path: str) -> Any:
    """A figure of a record, by the keys that lead to it, with dots between."""
    found: Any = record(name)["figures"]
    for key in path.split("."):
        if not isinstance(found, dict) or key not in found:
            raise MissingFigureError(f"{name}: expected the figure {path}, found none")
        found = found[key]
    return found


def pivot(
    name: str, index: str, columns: str, value: str, scale: float = 1.0, decimals: int = 1, **where: Any
) -> str:
    """A Markdown table of means: one line per value of `index`, one column per value of `columns`."""
    table = rows(name, **where)
    found = table.pivot_table(index=index, columns=columns, values=value, aggfunc="mean", sort=False)
    cells = (found * scale).map(lambda number: "" if pd.isna(number) else f"{number:.{decimals}f}")
    return markdown(cells.reset_index())


def markdown(table: pd.DataFrame) -> str:
    """A table in Markdown."""
    lines = [list(table.columns), ["---"] * len(table.columns), *table.to_numpy().tolist()]
    return "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines)


def _cell(content: Any) -> str:
    """A cell of a table; a vertical bar is escaped outside of code only."""
    text = str(content)
    return text if text.startswith("`") else text.replace("|", "\\|")


def part(file: str, title: str) -> str:
    """The section below a title of a Markdown file beside the records."""
    path = _results.FOLDER / file
    sections = path.read_text(encoding="utf-8").split("## ")
    found = [section.partition("\n")[2].strip() for section in sections if section.startswith(title)]
    if len(found) != 1:
        raise MissingFigureError(f"{path}: expected one section {title!r}, found {len(found)}")
    return found[0]


def accuracy_table() -> str:
    """The accuracy table of the README: mean error, and the error without constant offsets in brackets, millimetres."""
    sequences = {
        "S01_D2_A": "two drones that pass at 0.3 m",
        "S02_D4_A": "four drones",
        "S04_D10": "ten drones, passes at 0.4 m",
    }
    methods = {
        "swarm": "swarm, the default",
        "lines on blobs": "projection lines, from the foreground",
        "lines on detections": "projection lines, from detections",
        "fused": "both, fused",
    }
    table = all_rows("reference")
    lines = [["", *(f"{name}: {words}" for name, words in sequences.items())]]
    for method, title in methods.items():
        chosen = table[table["method"] == method]
        means = [
            chosen.loc[chosen["flight"].str.startswith(name), ["mean_mm", "centred_mm"]].mean()
            for name in sequences
        ]
        lines.append([title, *(f"{raw:.0f} mm ({centred:.1f} mm)" for raw, centred in means)])
    lines.append(["the paper, on its own videos", *(published(name) for name in sequences)])
    background = TrackSettings().silhouettes.background
    made = f"Background model: `{background}`, the default. Made by {provenance('reference')}."
    return f"{markdown(pd.DataFrame(lines[1:], columns=lines[0]))}\n\n{made}"


def published(name: str) -> str:
    """Range of the mean errors that the paper states for a sequence."""
    path = ROOT / "experiments" / "table5" / "published.toml"
    low, high = tomllib.loads(path.read_text(encoding="utf-8"))[name]
    return f"{1000 * low:.0f} to {1000 * high:.0f} mm" if high > low else f"{1000 * low:.0f} mm"


def provenance(name: str) -> str:
    """One line that says how a figure was made."""
    facts = record(name)
    machine = facts["machine"]
    where = f"{machine['processors']} processors of {machine['processor']}"
    text = f"`{facts['command']}`, version {facts['tracking']} of tracking, "
    text += f"commit {facts['commit'][:7]}, {facts['date'][:10]}, {where}"
    if facts["dirty"]:
        text += f", with local changes in {len(facts['dirty'])} files"
    return text


def records() -> str:
    """A table of all headline figures with their records."""
    lines = [
        {"figure": f"`{name}`", "shows": one.says, "minutes": f"{one.minutes:g}", "made by": provenance(name)}
        for name, one in _results.registry().items()
    ]
    return markdown(pd.DataFrame(lines))


def outdated() -> list[str]:
    """One line for each figure that is of another version of tracking."""
    return _results.outdated()


def cli_reference() -> str:
    """The help of every command."""
    from psotrack.cli import cli

    return "\n\n".join(_help(cli, click.Context(cli, info_name="psotrack", terminal_width=100), 2))


def _help(command: click.Command, context: click.Context, level: int) -> Iterator[str]:
    path = context.command_path
    yield f"{'#' * level} {path} {{ #{path.replace(' ', '-')} }}\n\n```text\n{command.get_help(context)}\n```"
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            inner = command.commands[name]
            yield from _help(inner, click.Context(inner, parent=context, info_name=name), min(level + 1, 3))


def struct_tables(path: str) -> str:
    """Markdown tables of the fields of a msgspec Struct and of its inner Structs.

    Args:
        path: dotted path of the class, for instance "psotrack.settings.TrackSettings".
    """
    module, _, name = path.rpartition(".")
    cls = getattr(import_module(module), name)
    return "\n\n".join(_struct_tables(cls, "", set()))


def _struct_tables(cls: type, prefix: str, done: set[type]) -> list[str]:
    done.add(cls)
    summary, descriptions = _docstring(cls)
    lines, nested = [], []
    for field in msgspec.structs.fields(cls):
        inner = [one for one in _structs(field.type) if one not in done]
        title = f"`{prefix}{field.encode_name}`"
        default = _default(field)
        lines.append([title, f"`{_type_name(field.type)}`", default, descriptions.get(field.name, "")])
        for one in inner:
            nested += _struct_tables(one, f"{prefix}{field.encode_name}.", done)
    table = pd.DataFrame(lines, columns=["field", "type", "default", "meaning"])
    tag = cls.__struct_config__.tag
    title = (prefix.rstrip(".") or cls.__name__) + (f" of kind {tag}" if tag else "")
    heading = f"### {title} {{ #{cls.__name__.lower()} }}"
    return [heading, summary, markdown(table), *nested]


def _structs(kind: Any) -> list[type]:
    """Struct classes inside of a type."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return [kind]
    return [one for inner in getattr(kind, "__args__", ()) for one in _structs(inner)]


def _default(field: Any) -> str:
    if field.default is not msgspec.NODEFAULT:
        inner = isinstance(field.default, msgspec.Struct)
        return "see below" if inner else f"`{json.dumps(msgspec.to_builtins(field.default))}`"
    if field.default_factory is not msgspec.NODEFAULT:
        return (
            "see below"
            if isinstance(field.default_factory, type) and _structs(field.default_factory)
            else "empty"
        )
    return "required"


def _type_name(kind: Any) -> str:
    """A type as people write it in code, without limits of values."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Ellipsis or kind is NoneType:
        return "..." if kind is Ellipsis else "None"
    if origin is Annotated:
        return _type_name(inner[0])
    if origin is Literal:
        return " | ".join(json.dumps(value) for value in inner)
    if origin in (Union, UnionType):
        return " | ".join(map(_type_name, inner))
    return f"{origin.__name__}[{', '.join(map(_type_name, inner))}]" if origin else kind.__name__


def _docstring(cls: type) -> tuple[str, dict[str, str]]:
    """The summary of a class, and the descriptions of its attributes by name."""
    text = split_shared_items(inspect.cleandoc(cls.__doc__ or ""))
    sections = Docstring(text, lineno=1).parse("google", warnings=False)
    texts = [one.value for one in sections if one.kind is DocstringSectionKind.text]
    found: dict[str, str] = {}
    for section in sections:
        if section.kind is DocstringSectionKind.attributes:
            for attribute in section.value:
                found[attribute.name] = " ".join(attribute.description.split())
    return (texts[0] if texts else ""), found


def millimetres(value_m: float, decimals: int = 1) -> str:
    """Metres in millimetres."""
    return f"{1e3 * value_m:.{decimals}f}"


def percent(value: float, decimals: int = 0) -> str:
    """A share in percent."""
    return f"{100 * value:.{decimals}f}"


def number(value: float, decimals: int = 1) -> str:
    """A number with a fixed count of decimals."""
    return f"{value:,.{decimals}f}"


ENVIRONMENT = Environment(undefined=StrictUndefined, autoescape=False, keep_trailing_newline=True)
ENVIRONMENT.filters.update(mm=millimetres, percent=percent, number=number)
ENVIRONMENT.globals.update({name: partial(statistic, how) for name, how in STATISTICS.items()})
ENVIRONMENT.globals.update(
    {
        function.__name__: function
        for function in (
            figure, pivot, part, accuracy_table, cli_reference, published, provenance, records,
            struct_tables, rows,
        )
    }
)  # fmt: skip


def render(text: str) -> str:
    """A page with its figures filled in."""
    return ENVIRONMENT.from_string(text).render()

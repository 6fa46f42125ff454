"""Options from records of settings: a field is an option, and its type, default and docstring are the option's.

The record stands where the work is done, so a setting is described once, for Python and for the command line. A field's
description is the option's help; its end `None: TEXT.` becomes `[default: TEXT]`.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource
from msgspec.inspect import (
    BoolType,
    CustomType,
    DataclassType,
    FloatType,
    IntType,
    LiteralType,
    Metadata,
    NoneType,
    StrType,
    StructType,
    TupleType,
    UnionType,
    VarTupleType,
    type_info,
)

from psotrack.cli.types import Distance, Names, Numbers, Size

Command = Callable[..., Any]

#: Ends of the names of fields that state a unit; options state it in their help.
_UNITS = re.compile(r"_(m|mm|s|m_s|hz|deg|px|mb|m_s2|m2_s5)$")
#: End of a description that says what the default None means.
_NONE = re.compile(r"[.;,] None: (.*?)\.?$")


class Option(click.Option):
    """An option with a heading in the help.

    Args:
        heading: heading of the option's part of the help.
        rare: whether --help leaves the option out, and only --help-all shows it.
        attributes: all other arguments of `click.Option`.
    """

    def __init__(self, *args: Any, heading: str = "Options", rare: bool = False, **attributes: Any) -> None:
        super().__init__(*args, **attributes)
        self.heading, self.rare = heading, rare


class HelpfulCommand(click.Command):
    """Command whose help has its options under headings, the rare ones only with --help-all."""

    def __init__(self, name: str | None, *, params: list[click.Parameter], **attributes: Any) -> None:
        if any(getattr(param, "rare", False) for param in params):
            flag: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False}
            words = "Show all options."
            params = [*params, Option(["--help-all"], callback=_show_all, help=words, **flag)]
        super().__init__(name, params=params, **attributes)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options."""
        everything = ctx.meta.get("psotrack.help_all", False)
        parts: dict[str, list[tuple[str, str]]] = {"Options": []}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx) if isinstance(param, click.Option) else None
            if record is not None and (everything or not getattr(param, "rare", False)):
                parts.setdefault(getattr(param, "heading", "Options"), []).append(record)
        for heading, records in parts.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


def _show_all(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        context.meta["psotrack.help_all"] = True
        click.echo(context.get_help(), color=context.color)
        context.exit()


@dataclass(frozen=True)
class Field:
    """A field of a record, or of a record inside of it.

    Attributes:
        name: dotted name, such as `swarm.particles`.
        kind: its type, as msgspec describes it.
        default: its default; None where it has none.
        required: whether it has no default.
        words: its description.
    """

    name: str
    kind: Any
    default: Any
    required: bool
    words: str


def fields_of(record: type, prefix: str = "") -> Iterator[Field]:
    """Fields of a record of msgspec or a dataclass, with those of the records inside of it.

    Args:
        record: the record; its docstring describes the fields under `Attributes:`.
        prefix: what stands before the names.
    """
    described = _descriptions(record)
    info = type_info(record)
    assert isinstance(info, StructType | DataclassType)
    for field in info.fields:
        if isinstance(field.type, StructType | DataclassType):
            yield from fields_of(field.type.cls, f"{prefix}{field.name}.")
        else:
            default = None if field.required else field.default
            words = described.get(field.name, "")
            yield Field(f"{prefix}{field.name}", field.type, default, field.required, words)


def _descriptions(record: type) -> dict[str, str]:
    """Description of each field, from the part `Attributes:` of a docstring; several names may share one."""
    text = inspect.getdoc(record) or ""
    part = text.partition("Attributes:\n")[2].partition("\n\n")[0]
    found = re.findall(r"^    ([a-z_0-9, ]+): (.*(?:\n {8}.*)*)", part, re.MULTILINE)
    return {name.strip(): " ".join(words.split()) for names, words in found for name in names.split(",")}


def option_of(
    field: Field, *, flag: str = "", heading: str = "Options", rare: bool = False, limited: bool = False
) -> Callable[[Command], Command]:
    """The option of a field.

    Args:
        field: the field.
        flag: name of the option, without dashes; "" is the field's name without its unit.
        heading: heading of the option's part of the help.
        rare: whether only --help-all shows the option.
        limited: whether the option has the limits of the field; else the record refuses what exceeds them.
    """
    kind, said = _plain_kind(field.kind)
    name = flag or _UNITS.sub("", field.name.rpartition(".")[2]).replace("_", "-")
    words, default = _sentence(field.words)
    if not default and not isinstance(field.default, bool) and field.default not in (None, "", ()):
        default = (
            ",".join(map(str, field.default)) if isinstance(field.default, tuple) else str(field.default)
        )
    declared, flag_value = f"--{name}", {}
    value = _number_type(kind, limited) if isinstance(kind, IntType | FloatType) else str
    if isinstance(kind, BoolType):
        declared = f"--{name}/--no-{name}" if field.default else f"--{name}"
        flag_value, default = {"is_flag": True}, f"--{name}" if field.default else ""
    elif isinstance(kind, LiteralType):
        value = click.Choice(list(kind.values))
    elif isinstance(kind, TupleType | VarTupleType):
        value = _tuple_type(kind)
    elif isinstance(kind, CustomType) and issubclass(kind.cls, Path):
        value = click.Path(path_type=Path)
    return click.option(
        declared,
        parameter_name(field.name),
        cls=Option,
        heading=heading,
        rare=rare,
        type=None if flag_value else said.get("type", value),
        default=field.default,
        required=field.required,
        metavar=said.get("metavar"),
        help=f"{words}  [default: {default}]" if default else words,
        **flag_value,
    )


def _number_type(kind: IntType | FloatType, limited: bool) -> Any:
    """Type of an option whose value is a number, with the limits of the field."""
    smallest, largest = (b if a is None else a for a, b in ((kind.gt, kind.ge), (kind.lt, kind.le)))
    whole = isinstance(kind, IntType)
    if not limited or (smallest is None and largest is None):
        return int if whole else float
    make: Any = click.IntRange if whole else click.FloatRange
    return make(smallest, largest, min_open=kind.gt is not None, max_open=kind.lt is not None)


def _tuple_type(kind: TupleType | VarTupleType) -> click.ParamType:
    """Type of an option whose value is a tuple: names, numbers, a size, or two names and a distance."""
    if isinstance(kind, VarTupleType):
        return Names() if isinstance(kind.item_type, StrType) else Numbers(0)
    items = {type(_plain_kind(each)[0]) for each in kind.item_types}
    return Size() if items == {IntType} else Distance() if StrType in items else Numbers(len(kind.item_types))


def _plain_kind(kind: Any) -> tuple[Any, dict[str, Any]]:
    """A type without None and without what is only said about it, and what is said: `metavar`, `type`."""
    said: dict[str, Any] = {}
    while isinstance(kind, Metadata | UnionType):
        if isinstance(kind, Metadata):
            kind, said = kind.type, said | (kind.extra or {})
        else:
            kind = next(each for each in kind.types if not isinstance(each, NoneType))
    return kind, said


def parameter_name(field: str) -> str:
    """Name of a field's parameter in click: `swarm.particles` -> `swarm__particles`."""
    return field.replace(".", "__")


def _sentence(words: str) -> tuple[str, str]:
    """Help of an option, and what its default is where none is given."""
    default = ""
    if found := _NONE.search(words):
        words, default = words[: found.start()], found[1]
    words = re.sub(r"`([a-z_]+)`", lambda match: f"--{_UNITS.sub('', match[1]).replace('_', '-')}", words)
    words = words[:1].upper() + words[1:]
    return (words if words.endswith(".") else f"{words}."), default.replace("`", "")


def options_of(
    record: type,
    parameter: str,
    *,
    names: Mapping[str, str] | None = None,
    heading: str = "Options",
    rare: Collection[str] = (),
) -> Callable[[Command], Command]:
    """Add the options of a record, which the command gets as one argument.

    Args:
        record: the record.
        parameter: name of the command's argument that gets the record.
        names: names of options by field, where they are not the field's; "" leaves the field out.
        heading: heading of the options in the help.
        rare: names of fields whose options only --help-all shows.
    """
    names = names or {}
    fields = [field for field in fields_of(record) if names.get(field.name) != ""]

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def with_record(*args: Any, **options: Any) -> None:
            values = {field.name: options.pop(parameter_name(field.name)) for field in fields}
            command(*args, **options, **{parameter: record(**values)})

        decorated: Command = with_record
        for field in reversed(fields):
            flag, is_rare = names.get(field.name, ""), field.name in rare
            option = option_of(field, flag=flag, heading=heading, rare=is_rare, limited=True)
            decorated = option(decorated)
        return decorated

    return decorate


def is_given(context: click.Context, name: str) -> bool:
    """Whether the user, or a variable of the environment, gave the value of a parameter."""
    return context.get_parameter_source(name) not in (None, ParameterSource.DEFAULT)

"""Commands from functions: a signature is the list of a command's arguments and options, its docstring their help.

A parameter before the `*` is an argument, one after it an option; its type, default and description are the option's.
Descriptions stand below `Options:` at the end of the docstring, and those of a record's fields below `Attributes:` in
the record's own. So a setting is described once, for Python and for the command line. The end `None: TEXT.` of a
description becomes `[default: TEXT]`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import click
from click.core import ParameterSource
from msgspec import Struct
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

from psotrack.cli.output import Output
from psotrack.cli.types import DISTANCE, NAMES, RUNNING, SIZE, numbers

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
    """A field of a record, or of a record inside of it; or a parameter of a command.

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

    @property
    def parameter(self) -> str:
        """Name of its parameter in click: `swarm.particles` -> `swarm__particles`."""
        return self.name.replace(".", "__")


def fields_of(record: type, prefix: str = "") -> Iterator[Field]:
    """Fields of a record of msgspec or a dataclass, with those of the records inside of it.

    Args:
        record: the record; its docstring describes the fields under `Attributes:`.
        prefix: what stands before the names.
    """
    described = _descriptions(record, "Attributes")
    info = type_info(record)
    assert isinstance(info, StructType | DataclassType)
    for each in info.fields:
        if isinstance(each.type, StructType | DataclassType):
            yield from fields_of(each.type.cls, f"{prefix}{each.name}.")
        else:
            default = None if each.required else each.default
            words = described.get(each.name, "")
            yield Field(f"{prefix}{each.name}", each.type, default, each.required, words)


def _descriptions(described: Any, heading: str) -> dict[str, str]:
    """Description of each field, from a part of a docstring; several names may share one."""
    text = inspect.getdoc(described) or ""
    part = text.partition(f"{heading}:\n")[2].partition("\n\n")[0]
    found = re.findall(r"^    ([a-z_0-9, ]+): (.*(?:\n {8}.*)*)", part, re.MULTILINE)
    return {name.strip(): " ".join(words.split()) for names, words in found for name in names.split(",")}


def option_of(
    field: Field, flag: str = "", heading: str = "Options", rare: bool = False, *, limited: bool = True
) -> click.Parameter:
    """The option of a field.

    Args:
        field: the field.
        flag: name of the option, without dashes; "" is the field's name without its unit.
        heading: heading of the option's part of the help.
        rare: whether only --help-all shows the option.
        limited: whether the option has the limits of the field; else the record refuses what exceeds them.
    """
    kind, said = _plain_kind(field.kind)
    name = said.pop("flag", flag) or _UNITS.sub("", field.name.rpartition(".")[2]).replace("_", "-")
    words, default = _sentence(said.pop("words", field.words))
    if not default and not isinstance(field.default, bool) and field.default not in (None, "", ()):
        default = (
            ",".join(map(str, field.default)) if isinstance(field.default, tuple) else str(field.default)
        )
    declared = f"--{name}"
    attributes: dict[str, Any] = {"type": _type_of(kind, limited), "heading": heading, "rare": rare}
    if isinstance(kind, BoolType):
        declared = f"--{name}/--no-{name}" if field.default else f"--{name}"
        attributes |= {"type": None, "is_flag": True}
        default = f"--{name}" if field.default else default
    declarations = [declared, *said.pop("short", ()), field.parameter]
    attributes |= {"required": True} if field.required else {"default": field.default}
    attributes |= said
    return Option(declarations, help=f"{words}  [default: {default}]" if default else words, **attributes)


def _argument_of(field: Field) -> click.Parameter:
    """The argument of a parameter; a tuple takes as many as there are."""
    kind, said = _plain_kind(field.kind)
    if isinstance(kind, VarTupleType):
        said, kind = {"nargs": -1, **said}, kind.item_type
    usual: dict[str, Any] = {"type": _type_of(_plain_kind(kind)[0], True), "required": field.required}
    return click.Argument([field.name], **usual | said)


def _type_of(kind: Any, limited: bool) -> Any:
    """Type of the value of a parameter, in the words of click."""
    if isinstance(kind, IntType | FloatType):
        return _number_type(kind, limited)
    if isinstance(kind, LiteralType):
        return click.Choice(list(kind.values))
    if isinstance(kind, VarTupleType):
        return NAMES if isinstance(kind.item_type, StrType) else numbers(0)
    if isinstance(kind, TupleType):
        items = {type(_plain_kind(each)[0]) for each in kind.item_types}
        return SIZE if items == {IntType} else DISTANCE if StrType in items else numbers(len(kind.item_types))
    if isinstance(kind, CustomType) and issubclass(kind.cls, Path):
        return click.Path(path_type=Path)
    return str


def _number_type(kind: IntType | FloatType, limited: bool) -> Any:
    """Type of an option whose value is a number, with the limits of the field."""
    smallest, largest = (b if a is None else a for a, b in ((kind.gt, kind.ge), (kind.lt, kind.le)))
    whole = isinstance(kind, IntType)
    if not limited or (smallest is None and largest is None):
        return int if whole else float
    make: Any = click.IntRange if whole else click.FloatRange
    return make(smallest, largest, min_open=kind.gt is not None, max_open=kind.lt is not None)


def _plain_kind(kind: Any) -> tuple[Any, dict[str, Any]]:
    """A type without None and without what is only said about it, and what is said (see `says`)."""
    said: dict[str, Any] = {}
    while isinstance(kind, Metadata | UnionType):
        if isinstance(kind, Metadata):
            kind, said = kind.type, said | (kind.extra or {})
        else:
            kind = next(each for each in kind.types if not isinstance(each, NoneType))
    return kind, said


def _sentence(words: str) -> tuple[str, str]:
    """Help of an option, and what its default is where none is given."""
    default = ""
    if found := _NONE.search(words):
        words, default = words[: found.start()], found[1]
    words = re.sub(r"`([a-z_]+)`", lambda match: f"--{_UNITS.sub('', match[1]).replace('_', '-')}", words)
    words = words[:1].upper() + words[1:]
    return (words if words.endswith((".", "]")) else f"{words}."), default.replace("`", "")


def is_given(context: click.Context, name: str) -> bool:
    """Whether the user, or a variable of the environment, gave the value of a parameter."""
    return context.get_parameter_source(name) not in (None, ParameterSource.DEFAULT)


@dataclass(frozen=True)
class OptionGroup:
    """The options of a record's fields, which a command gets as one argument.

    Attributes:
        heading: heading of the options in the help.
        names: names of options by field, where they are not the field's; "" leaves the field out.
        rare: names of fields whose options only --help-all shows.
    """

    heading: str = "Options"
    names: Mapping[str, str] = field(default_factory=dict)
    rare: Collection[str] = ()

    def parameters(self, record: Any) -> list[click.Parameter]:
        """The options."""
        return [
            option_of(each, self.names.get(each.name, ""), self.heading, each.name in self.rare)
            for each in self._fields(record)
        ]

    def take(self, record: Any, values: Mapping[str, Any]) -> Any:
        """The argument of the command, from the values of the parameters of click."""
        return record(**{each.name: values[each.parameter] for each in self._fields(record)})

    def finish(self, taken: Any, values: Mapping[str, Any]) -> None:
        """What is to be done when the command has succeeded."""

    def _fields(self, record: Any) -> list[Field]:
        return [each for each in fields_of(record) if self.names.get(each.name) != ""]


def command(
    name: str = "", *, without: Collection[str] = ()
) -> Callable[[Callable[..., None]], HelpfulCommand]:
    """Make a command of a function, whose first argument is the command's `Output`.

    Args:
        name: name of the command; "" is the function's.
        without: fields of `Output` that have no option, such as `json_path` where there are no results.
    """

    def decorate(function: Callable[..., None]) -> HelpfulCommand:
        hints = get_type_hints(function, include_extras=True)
        words = _descriptions(function, "Options")
        of_output = OptionGroup(RUNNING, {"json_path": "json", "started_s": "", **dict.fromkeys(without, "")})
        groups: dict[str, tuple[Any, OptionGroup]] = {}
        params: list[click.Parameter] = []
        for each in list(inspect.signature(function).parameters.values())[1:]:
            if (group := _group_of(hints[each.name])) is not None:
                groups[each.name] = group
                params += group[1].parameters(group[0])
                continue
            is_required = each.default is each.empty
            default = None if is_required else each.default
            kind, description = type_info(hints[each.name]), words.get(each.name, "")
            single = Field(each.name, kind, default, is_required, description)
            params.append(option_of(single) if each.kind is each.KEYWORD_ONLY else _argument_of(single))

        def run(**values: Any) -> None:
            with of_output.take(Output, values).opened() as output:
                taken = {key: group.take(record, values) for key, (record, group) in groups.items()}
                plain = {key: value for key, value in values.items() if key in hints}
                function(output, **plain | taken)
                for key, (_, group) in groups.items():
                    group.finish(taken[key], values)

        return HelpfulCommand(
            name or function.__name__,
            callback=run,
            params=params + of_output.parameters(Output),
            help=inspect.cleandoc(function.__doc__ or "").partition("\n\nOptions:\n")[0],
        )

    return decorate


def _group_of(hint: Any) -> tuple[Any, OptionGroup] | None:
    """The record of a parameter and how its options are shown; None for a single option or argument."""
    record, *said = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    group = next((each for each in said if isinstance(each, OptionGroup)), None)
    if group is None and inspect.isclass(record) and (is_dataclass(record) or issubclass(record, Struct)):
        group = OptionGroup()
    return None if group is None else (record, group)

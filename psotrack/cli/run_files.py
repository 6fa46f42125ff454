"""`--config FILE` and `--save-config FILE`: all arguments and options of a run as a TOML file that runs it again.

A file has one key per argument and option: `sequence = "flight"`, `max-speed = 8.0`. Relative paths in it start at the
file's folder, as in a `recording.toml`. What is typed on the command line has precedence over the file.
"""

from __future__ import annotations

import functools
import logging
import os
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import click
import msgspec

from psotrack import __version__
from psotrack.cli.options import Command, Numbers, Size, setting_name
from psotrack.errors import InputError, SettingsError
from psotrack.support import (
    atomic_write,
    convert,
    nearest,
    read_toml,
    refuse_to_overwrite,
    toml_key,
    toml_value,
)

_logger = logging.getLogger(__name__)

#: Options that are typed for each run: a file that replaces results without being asked would be a trap.
_TYPED = {"config", "save_config", "force", "help"}
#: Keys about the file itself: the command that the file is for, and the version that wrote it.
_COMMAND, _VERSION = "command", "psotrack"
#: Key of the path of `--config` in the notes of a command.
_CONFIG = "psotrack.config"
_WIDTH = 100


class FileOr(click.ParamType):
    """A path, or one of some words, or, with a suffix, any word that does not end so and is no file.

    Args:
        *words: values that are no paths.
        suffix: suffix of the files; "" for any.
    """

    name = "text"

    def __init__(self, *words: str, suffix: str = "") -> None:
        self._words, self._suffix = words, suffix

    def is_path(self, value: str, folder: Path) -> bool:
        """Whether a value is a path, relative to a folder."""
        if value in self._words:
            return False
        return not self._suffix or value.lower().endswith(self._suffix) or (folder / value).exists()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The value as text."""
        return str(value)


def run_file_options(command: Command) -> Command:
    """Add `--config` and `--save-config`; the file is written when the command has ended without an error."""

    @functools.wraps(command)
    def saving(*args: Any, save_config: Path | None, **options: Any) -> None:
        context = click.get_current_context()
        if save_config is not None:
            if save_config.suffix != ".toml":
                raise SettingsError(
                    "--save-config", expected="a file that ends in .toml", found=save_config.name
                )
            refuse_to_overwrite(save_config, context.params.get("force", False))
        try:
            command(*args, **options)
        except SettingsError as error:
            named = {f"{setting_name(name)}:" for name in _from_config(context)}
            if not str(error).startswith(tuple(named)):
                raise
            raise error.within(context.meta[_CONFIG]) from error
        if save_config is not None:
            with atomic_write(save_config) as temporary:
                temporary.write_text(config_text(context, save_config.parent), encoding="utf-8")

    config = click.option(
        "--config",
        type=click.Path(path_type=Path),
        metavar="FILE.toml",
        is_eager=True,
        expose_value=False,
        callback=_take_config,
        help="Take arguments and options from FILE.toml, as --save-config writes it; what is typed has precedence.",
    )
    save = click.option(
        "--save-config",
        type=click.Path(path_type=Path),
        metavar="FILE.toml",
        help="Write all arguments and options of this run, except --force, to FILE.toml at the end.",
    )
    return config(save(saving))


def config_text(context: click.Context, folder: Path) -> str:
    """The arguments and options of a run as TOML, with the help as comments; those without a value are comments too.

    Args:
        context: context of the command.
        folder: folder of the file, to which relative paths are changed.
    """
    name = context.command.name or ""
    lines = [
        f"# psotrack {name} --config FILE runs this again. Relative paths start at the folder of this file.",
        f"{_COMMAND} = {toml_value(name)}",
        f"{_VERSION} = {toml_value(__version__)}",
    ]
    for param in _saved_params(context.command):
        # Options that the command does not get are in `meta`.
        value = context.params.get(param.name or "", context.meta.get(f"psotrack.{param.name}"))
        lines.append("")
        if isinstance(param, click.Option) and param.help:
            words = param.help.replace("\b", "").split()
            lines += textwrap.wrap(" ".join(words), _WIDTH, initial_indent="# ", subsequent_indent="# ")
        key = toml_key(_key(param))
        lines.append(f"# {key} =" if value is None else f"{key} = {toml_value(_plain(param, value, folder))}")
    return "\n".join([*lines, ""])


def _take_config(context: click.Context, _: click.Parameter, path: Path | None) -> None:
    """Make the values of a file the defaults of the command."""
    if path is None or context.resilient_parsing:
        return
    context.meta[_CONFIG] = path
    context.default_map = {**(context.default_map or {}), **_read_config(path, context.command)}


def _from_config(context: click.Context) -> list[str]:
    """Names of the parameters whose values are from the file of `--config`."""
    return [
        param.name or ""
        for param in _saved_params(context.command)
        if context.get_parameter_source(param.name or "") is click.core.ParameterSource.DEFAULT_MAP
    ]


def _read_config(path: Path, command: click.Command) -> dict[str, Any]:
    """The values of a file by the names of the parameters of a command.

    Raises:
        InputError: the file cannot be read, is for another command, or has a wrong key or value.
    """
    data = read_toml(path)
    name, version = data.pop(_COMMAND, command.name), data.pop(_VERSION, __version__)
    if name != command.name:
        found = toml_value(name) if isinstance(name, str) else f"{name}"
        raise InputError(f"{path}, {_COMMAND}", expected=f'"{command.name}"', found=found)
    if version != __version__:
        _logger.warning(
            "%s was written by psotrack %s; this is %s, whose results may differ", path, version, __version__
        )
    params = {_key(param): param for param in _saved_params(command)}
    for key in data:
        if key not in params:
            typed = "it is typed for each run" if key.replace("-", "_") in _TYPED else ""
            near = nearest(key.replace("_", "-"), params)
            raise InputError(
                f"{path}, {key}",
                expected=f"an argument or option of psotrack {command.name}",
                found=key,
                remedy=typed
                or (f"did you mean {near}?" if near else f"see `psotrack {command.name} --help`"),
            )
    kind = msgspec.defstruct(
        "Config",
        [(param.name or "", _type_of(param), None) for param in params.values()],
        rename={param.name or "": key for key, param in params.items()},
    )

    def error(key: str, expected: str, found: str, remedy: str) -> InputError:
        return InputError(f"{path}, {key}", expected=expected, found=found, remedy=remedy)

    record = convert(data, kind, error)
    return {
        param.name or "": _placed(param, getattr(record, param.name or ""), path.parent)
        for key, param in params.items()
        if key in data
    }


def _saved_params(command: click.Command) -> Iterator[click.Parameter]:
    return (param for param in command.params if param.name not in _TYPED)


def _key(param: click.Parameter) -> str:
    """Key of a parameter: the name of an argument, or the long name of an option without dashes before it."""
    if isinstance(param, click.Argument):
        return param.name or ""
    return max(param.opts, key=len).lstrip("-")


def _type_of(param: click.Parameter) -> Any:
    """Type of a parameter's value in a file."""
    kind = param.type
    if isinstance(param, click.Option) and param.is_flag:
        return bool
    if isinstance(kind, Numbers):
        return tuple[(float,) * kind.count]  # type: ignore[misc]
    if isinstance(kind, Size):
        return tuple[int, int]
    if isinstance(kind, click.Choice):
        return Literal[tuple(kind.choices)]
    number = int if isinstance(kind, click.types.IntParamType) else float
    if isinstance(kind, click.IntRange | click.FloatRange):
        limits: dict[str, Any] = {"gt" if kind.min_open else "ge": kind.min}
        limits["lt" if kind.max_open else "le"] = kind.max
        return Annotated[number, msgspec.Meta(**limits)]
    return number if isinstance(kind, click.types.IntParamType | click.types.FloatParamType) else str


def _plain(param: click.Parameter, value: Any, folder: Path) -> Any:
    """A value for the file: relative paths start at the file's folder."""
    if _is_path(param, value, Path()) and not Path(value).is_absolute():
        return Path(os.path.relpath(value, folder)).as_posix()
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _placed(param: click.Parameter, value: Any, folder: Path) -> Any:
    """A value of a file as the command takes it: relative paths start at the current folder."""
    if isinstance(param.type, Size) and value is not None:
        return "{},{}".format(*value)
    return os.fspath(folder / value) if _is_path(param, value, folder) else value


def _is_path(param: click.Parameter, value: Any, folder: Path) -> bool:
    """Whether a value is a path that is relative to a folder, or absolute; - is stdout."""
    if isinstance(param.type, FileOr):
        return value is not None and param.type.is_path(value, folder)
    return isinstance(param.type, click.Path) and value is not None and os.fspath(value) != "-"

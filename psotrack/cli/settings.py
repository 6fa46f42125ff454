"""Settings of tracking as options: an option for each setting, --set, --config and --save-config.

A setting is found in this order: what is typed, the file of --config, the archive that is tracked again, the default.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import click
import msgspec

from psotrack import __version__
from psotrack.cli.archived import archive_of
from psotrack.cli.output import check_suffix, current_output
from psotrack.cli.records import Command, Option, fields_of, is_given, option_of, parameter_name
from psotrack.cli.types import change_of
from psotrack.errors import SettingsError
from psotrack.settings import TrackSettings, flatten
from psotrack.support import atomic_write, read_toml, toml_value

#: Names of options that are not those of the settings.
_NAMES = {
    "swarm.kind": "swarm",
    "score.kind": "score",
    "drones.count": "drones",
    "drones.size_m": "drone-size",
    "status.min_cameras_to_begin": "min-cameras",
    "status.min_cameras": "min-cameras-to-go-on",
    "errors.rig_deg": "rig-error",
    "errors.pixel_px": "pixel-error",
    "silhouettes.min_blob_px": "min-blob",
    "silhouettes.drone_px": "drone-px",
}


def settings_options(
    *common: str, part: str = "", without: Collection[str] = ()
) -> Callable[[Command], Command]:
    """Add an option for each setting, --set and --help-all; the command gets `settings`, the values by dotted name.

    Args:
        common: dotted names of the settings whose options --help shows.
        part: the part of the settings, such as "silhouettes."; "" for all.
        without: dotted names of settings without an option.
    """
    fields = [
        field
        for field in fields_of(TrackSettings)
        if field.name.startswith(part) and field.name not in without
    ]

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def with_settings(*args: Any, set_changes: tuple[str, ...], **options: Any) -> None:
            context = click.get_current_context()
            given = {field.name: options.pop(parameter_name(field.name)) for field in fields}
            chosen = {name: value for name, value in given.items() if is_given(context, parameter_name(name))}
            changes = dict(map(change_of, set_changes))
            command(*args, **options, settings=chosen | changes)

        decorated: Command = with_settings
        for field in reversed(fields):
            option = option_of(
                field,
                flag=_NAMES.get(field.name, ""),
                heading=_heading(field.name, common),
                rare=field.name not in common,
            )
            decorated = option(decorated)
        sets = click.option(
            "--set",
            "set_changes",
            multiple=True,
            metavar="NAME=VALUE",
            help="Change a setting by its name in sweeps, such as swarm.particles=50; may be repeated. --help-all "
            "lists the settings.",
        )
        return sets(decorated)

    return decorate


def _heading(name: str, common: Collection[str]) -> str:
    part = name.rpartition(".")[0]
    return "Options" if name in common else f"Settings {part}.*" if part else "Settings"


def config_options(command: Command) -> Command:
    """Add --config and --save-config to a command with `settings_options`."""

    @functools.wraps(command)
    def with_files(
        *args: Any, config: Path | None, save_config: Path | None, settings: dict[str, Any], **options: Any
    ) -> None:
        check_suffix("--save-config", save_config, ".toml")
        current_output().refuse(save_config)
        in_file = {} if config is None else read_config(config)
        command(*args, **options, settings=in_file | settings)
        if save_config is not None:
            with atomic_write(save_config) as temporary:
                temporary.write_text(config_text(chosen_settings(in_file | settings)), encoding="utf-8")

    path = functools.partial(click.option, type=click.Path(path_type=Path), metavar="FILE.toml", cls=Option)
    config = path("--config", help="Take settings from FILE.toml; what is typed has precedence.")
    save = path("--save-config", help="Write all settings of this run to FILE.toml at the end.")
    return config(save(with_files))


def read_config(path: Path) -> dict[str, Any]:
    """The settings of a file by their dotted names.

    Raises:
        InputError: the file cannot be read.
        SettingsError: the file has an unknown setting, or a value that is not allowed.
    """
    found = dict(flatten(read_toml(path)))
    try:
        TrackSettings().changed(found)
    except SettingsError as error:
        raise error.within(path) from error
    return found


def config_text(settings: TrackSettings) -> str:
    """Settings as TOML; those without a value are comments."""
    lines = [f"# Settings of psotrack {__version__}: psotrack track SEQ --config FILE uses them."]
    for name, value in flatten(msgspec.to_builtins(settings)):
        lines.append(f"# {name} =" if value is None else f"{name} = {toml_value(value)}")
    return "\n".join([*lines, ""])


def chosen_settings(chosen: Mapping[str, Any]) -> TrackSettings:
    """The settings of a run: those that the user chose, and else those of the archive, or the defaults.

    Args:
        chosen: values by dotted name.

    Raises:
        InputError: the archive has settings that this version does not know.
        SettingsError: a name is unknown, or a value is not allowed.
    """
    archive = archive_of(click.get_current_context())
    return (TrackSettings() if archive is None else archive.settings).changed(chosen)

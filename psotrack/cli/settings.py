"""Settings of tracking as options: an option for each setting, --config and --save-config.

A setting is found in this order: what is typed, the file of --config, the archive that is tracked again, the default.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import click
import msgspec

from psotrack import __version__
from psotrack.cli.archived import archive_of
from psotrack.cli.commands import Field, OptionGroup, fields_of, is_given, option_of
from psotrack.cli.output import check_suffix
from psotrack.cli.types import says
from psotrack.errors import SettingsError
from psotrack.settings import TrackSettings, flatten
from psotrack.support import atomic_write, read_toml, refuse_files, toml_value

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


@dataclass(frozen=True)
class TrackingSettings(OptionGroup):
    """An option for each setting, and --help-all; the command gets the values that were given, by dotted name.

    Attributes:
        usual: dotted names of the settings whose options --help shows.
        part: the part of the settings, such as "silhouettes."; "" for all.
        without: dotted names of settings without an option.
        files: whether there are --config and --save-config.
    """

    usual: Collection[str] = ()
    part: str = ""
    without: Collection[str] = ()
    files: bool = True

    def parameters(self, record: Any) -> list[click.Parameter]:
        """The options."""
        files = fields_of(_Files) if self.files else ()
        return [*map(self._option, self._fields(record)), *map(option_of, files)]

    def _fields(self, record: Any) -> list[Field]:
        fields = fields_of(TrackSettings)
        return [each for each in fields if each.name.startswith(self.part) and each.name not in self.without]

    def _option(self, field: Field) -> click.Parameter:
        part, is_usual = field.name.rpartition(".")[0], field.name in self.usual
        heading = "Options" if is_usual else f"Settings {part}.*" if part else "Settings"
        return option_of(field, _NAMES.get(field.name, ""), heading, not is_usual, limited=False)

    def take(self, record: Any, values: Mapping[str, Any]) -> dict[str, Any]:
        """The values of the settings that the user chose."""
        files = _Files(values.get("config"), values.get("save_config"))
        check_suffix("--save-config", files.save_config, ".toml")
        if files.save_config is not None:
            refuse_files(files.save_config, force=values["force"])
        context = click.get_current_context()
        chosen = {} if files.config is None else read_config(files.config)
        for field in self._fields(record):
            if is_given(context, field.parameter):
                chosen[field.name] = values[field.parameter]
        return chosen

    def finish(self, taken: dict[str, Any], values: Mapping[str, Any]) -> None:
        """Write the file of --save-config."""
        if (path := values.get("save_config")) is not None:
            with atomic_write(path) as temporary:
                temporary.write_text(config_text(chosen_settings(taken)), encoding="utf-8")


@dataclass(frozen=True)
class _Files:
    """Files of settings.

    Attributes:
        config: take settings from FILE.toml; what is typed has precedence.
        save_config: write all settings of this run to FILE.toml at the end.
    """

    config: Annotated[Path, says(metavar="FILE.toml")] | None = None
    save_config: Annotated[Path, says(metavar="FILE.toml")] | None = None


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

"""Settings of tracking as options, and archives as sequences, whose settings `track` uses again.

There is an option for each setting, --config and --save-config. A setting is found in this order: what is typed, the
file of --config, the archive that is tracked again, the default.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import click
import msgspec

from psotrack import __version__
from psotrack.cli.commands import Field, OptionGroup, fields_of, is_given, option_of
from psotrack.cli.output import check_suffix
from psotrack.cli.types import ARCHIVE, archive_of, says
from psotrack.errors import InputError, SettingsError
from psotrack.pipeline import archives
from psotrack.settings import TrackSettings, flatten
from psotrack.support import atomic_write, read_toml, refuse_files, toml_value


@dataclass(frozen=True)
class OpenedArchive:
    """An archive that a command was given as SEQ.

    Attributes:
        path: path of the archive.
        folder: folder of its content, which exists as long as the command runs.
        manifest: its manifest.
    """

    path: Path
    folder: Path
    manifest: archives.Manifest

    @property
    def settings(self) -> TrackSettings:
        """The settings of the archive's tracks; a file of first positions is named where it lies now.

        Raises:
            InputError: this version does not know these settings.
        """
        try:
            settings = self.manifest.track_settings()
        except msgspec.ValidationError as error:
            raise InputError(
                self.path, expected="settings of this version of psotrack", found=f"{error}"
            ) from error
        start = self.folder / settings.init
        return settings.changed({"init": f"{start}"}) if start.is_file() else settings

    def without_place(self, settings: TrackSettings) -> TrackSettings:
        """The same settings with the name that a file of first positions has in the archive."""
        start = Path(settings.init)
        if not start.is_relative_to(self.folder):
            return settings
        return settings.changed({"init": start.relative_to(self.folder).as_posix()})


def opened_archive(context: click.Context, path: Path) -> Path:
    """Unpack an archive for the time of a command; returns the folder, which has the name of the recording.

    Raises:
        InputError: the archive does not exist, was cut short or changed, or is of a newer version.
    """
    temporary = Path(context.with_resource(tempfile.TemporaryDirectory(prefix="psotrack-")))
    manifest = archives.unpack(path, temporary / "archive")
    # `unpack` refuses names that lead elsewhere, but this name is no path of the archive.
    name = Path(manifest.sequence).name or "archive"
    folder = (temporary / "archive").rename(temporary / name)
    context.meta[ARCHIVE] = OpenedArchive(path, folder, archives.read_manifest(folder))
    return folder


def chosen_extent(num_frames: int | None, causal: bool, most_drones: int) -> tuple[int | None, bool, int]:
    """The values of --frames, --causal and --most-drones: those of an archive where the user chose none."""
    archive = archive_of()
    if archive is None:
        return num_frames, causal, most_drones
    packed = archive.manifest
    if packed.most_drones is not None and not is_given(click.get_current_context(), "most_drones"):
        most_drones = packed.most_drones
    return num_frames or packed.frames, causal or packed.causal, most_drones


def with_comparison(
    record: dict[str, Any], tracks: Path, settings: TrackSettings
) -> tuple[dict[str, Any], str]:
    """The record of a run with the comparison to the archive that was tracked, and the end of a sentence about both.

    Args:
        record: record of the run.
        tracks: file of the tracks that was written.
        settings: settings of the run.

    Returns:
        The record, and words that begin with a semicolon; without an archive, the same record and no words.

    Raises:
        InputError: a file of the archive cannot be read.
    """
    archive = archive_of()
    if archive is None:
        return record, ""
    asked = archive.without_place(settings)
    comparison = archives.compare_with_archive(archive.folder, archive.manifest, tracks, record, asked)
    of_archive = {"file": archive.path.name, **comparison.to_dict()}
    return {**record, "archive": of_archive}, f"; {comparison.sentence(archive.path.name)}"


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
    archive = archive_of()
    return (TrackSettings() if archive is None else archive.settings).changed(chosen)

"""Archives as sequences: the folder of an archive for the time of a command, and what `track` adds for archives."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from psotrack.cli.commands import is_given
from psotrack.errors import InputError
from psotrack.settings import TrackSettings

if TYPE_CHECKING:
    from psotrack.pipeline.archives import Manifest

#: Key of the archive in the context of a command.
_ARCHIVE = "psotrack.archive"


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
    manifest: Manifest

    @property
    def settings(self) -> TrackSettings:
        """The settings of the archive's tracks; a file of first positions is named where it lies now.

        Raises:
            InputError: this version does not know these settings.
        """
        try:
            settings = self.manifest.track_settings()
        except msgspec.ValidationError as error:
            expected = "settings of this version of psotrack"
            raise InputError(self.path, expected=expected, found=f"{error}") from error
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
    from psotrack.pipeline.archives import read_manifest, unpack

    temporary = Path(context.with_resource(tempfile.TemporaryDirectory(prefix="psotrack-")))
    manifest = unpack(path, temporary / "archive")
    # `unpack` refuses names that lead elsewhere, but this name is no path of the archive.
    name = Path(manifest.sequence).name or "archive"
    folder = (temporary / "archive").rename(temporary / name)
    context.meta[_ARCHIVE] = OpenedArchive(path, folder, read_manifest(folder))
    return folder


def archive_of(context: click.Context) -> OpenedArchive | None:
    """The archive that the command was given as SEQ; None for any other recording."""
    return context.meta.get(_ARCHIVE)


def chosen_extent(num_frames: int | None, causal: bool, most_drones: int) -> tuple[int | None, bool, int]:
    """The values of --frames, --causal and --most-drones: those of an archive where the user chose none."""
    context = click.get_current_context()
    archive = archive_of(context)
    if archive is None:
        return num_frames, causal, most_drones
    packed = archive.manifest
    if packed.most_drones is not None and not is_given(context, "most_drones"):
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
    archive = archive_of(click.get_current_context())
    if archive is None:
        return record, ""
    from psotrack.pipeline.archives import compare_with_archive

    asked = archive.without_place(settings)
    comparison = compare_with_archive(archive.folder, archive.manifest, tracks, record, asked)
    of_archive = {"file": archive.path.name, **comparison.to_dict()}
    return {**record, "archive": of_archive}, f"; {comparison.sentence(archive.path.name)}"

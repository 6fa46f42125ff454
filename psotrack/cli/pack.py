"""`psotrack pack` and `psotrack unpack`: tracks with all that they were computed from, as one file and back."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import CACHE, FORCE, SEQUENCE, TRACKS, cache_folder, reporting
from psotrack.cli.output import print_line, report_to
from psotrack.errors import SettingsError
from psotrack.support import ARCHIVE_SUFFIX


@click.command()
@TRACKS
@SEQUENCE
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help=f"The archive; it ends in {ARCHIVE_SUFFIX}."
)
@click.option("--videos", is_flag=True, help="Pack the videos, too.  [default: a digest of each video]")
@CACHE
@FORCE
@reporting
def pack(
    tracks: Path, sequence: Path, out: Path, videos: bool, cache: Path | None, force: bool, quiet: bool
) -> None:
    """Pack TRACKS and what is needed to compute them again from SEQ into one file.

    SEQ is the recording from which TRACKS were computed. The archive holds TRACKS and their record, the cameras, the
    silhouettes, the detections and the reference. `track` computes the tracks again from the archive.

    \b
    Examples:
      psotrack pack tracks.csv data/Simulated_Data/S02_D4_A --out flight.psotrack
      psotrack pack tracks.csv flight --out flight.psotrack --videos
      psotrack track flight.psotrack --out again.csv
    """
    from psotrack.pipeline.archives import pack_tracks
    from psotrack.recordings.datasets import open_recording

    if out.suffix != ARCHIVE_SUFFIX:
        raise SettingsError("--out", expected=f"a file that ends in {ARCHIVE_SUFFIX}", found=out.name)
    manifest = pack_tracks(
        tracks,
        open_recording(sequence),
        out,
        cache=cache_folder(cache),
        videos=videos,
        force=force,
        report=report_to(quiet),
    )
    packed = f"{len(manifest.files)} files, {out.stat().st_size / 1e6:.3g} MB"
    print_line(quiet, None, f"{out}: {packed}" + ("" if videos else ", without videos"))


@click.command()
@click.argument("archive", metavar="FILE", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="The folder; it must not exist yet."
)
@click.option("--force", is_flag=True, help="Replace a folder into which an archive was unpacked.")
@reporting
def unpack(archive: Path, out: Path, force: bool, quiet: bool) -> None:
    """Unpack the archive FILE into a folder, which other commands take as SEQ.

    The whole archive is checked first: nothing is written if FILE was cut short or changed.

    \b
    Examples:
      psotrack unpack flight.psotrack --out flight
      psotrack evaluate flight/tracks.csv flight
    """
    from psotrack.pipeline.archives import unpack as unpack_archive

    manifest = unpack_archive(archive, out, force=force, report=report_to(quiet))
    print_line(quiet, None, f"{out}: {manifest.sequence}, {len(manifest.files)} files, {manifest.tracks}")

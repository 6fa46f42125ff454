"""`psotrack archive`: tracks with all that they were computed from, as one file, and back."""

from __future__ import annotations

from pathlib import Path

from psotrack.cli.commands import command
from psotrack.cli.options import Cache, SeqOfTracks, cache_folder, sequence_of
from psotrack.cli.output import Output, check_suffix
from psotrack.errors import SettingsError
from psotrack.support import ARCHIVE_SUFFIX


@command(without=["json_path"])
def archive(
    output: Output,
    tracks: Path,
    sequence: SeqOfTracks = None,
    *,
    out: Path | None = None,
    videos: bool = False,
    cache: Cache = None,
) -> None:
    """Pack TRACKS and what is needed to compute them again into one file, or unpack such a file.

    SEQ is the recording from which TRACKS were computed; the record beside TRACKS names it. The archive holds TRACKS
    and their record, the cameras, the silhouettes, the detections and the reference. `track` computes the tracks again
    from the archive. An archive as TRACKS is unpacked into a folder, which other commands take as SEQ; nothing is
    written if the archive was cut short or changed.

    \b
    Examples:
      psotrack archive my_lab/results/tracks.csv --out flight.psotrack
      psotrack archive tracks.csv my_lab --out flight.psotrack --videos
      psotrack track flight.psotrack --out again.csv
      psotrack archive flight.psotrack --out flight

    Options:
        out: the archive, which ends in .psotrack, or the folder into which one is unpacked. None: beside TRACKS, with
            the same name.
        videos: pack the videos, too. None: a digest of each video.
    """
    from psotrack.pipeline.archives import pack_tracks, unpack
    from psotrack.recordings.datasets import open_recording

    if tracks.suffix == ARCHIVE_SUFFIX and not tracks.is_dir():
        if sequence is not None or videos:
            found = f"{sequence}" if sequence is not None else "--videos"
            raise SettingsError("archive", expected="nothing else with an archive to unpack", found=found)
        out = out or tracks.with_suffix("")
        manifest = unpack(tracks, out, force=output.force, report=output.report)
        output.say(f"{out}: {manifest.sequence}, {len(manifest.files)} files, {manifest.tracks}")
        return
    out = out or tracks.with_suffix(ARCHIVE_SUFFIX)
    check_suffix("--out", out, ARCHIVE_SUFFIX)
    recording = open_recording(sequence_of(tracks, sequence))
    manifest = pack_tracks(
        tracks,
        recording,
        out,
        cache=cache_folder(cache),
        videos=videos,
        force=output.force,
        report=output.report,
    )
    packed = f"{len(manifest.files)} files, {out.stat().st_size / 1e6:.3g} MB"
    output.say(f"{out}: {packed}" + ("" if videos else ", without videos"))

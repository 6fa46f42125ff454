"""`psotrack view`: tracks, cameras and events in space and time, in the viewer Rerun."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import Annotated

import click
from msgspec import Meta

from psotrack.cli.commands import command
from psotrack.cli.options import Dictionary, Extent
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import opened_sequence, says
from psotrack.errors import SettingsError
from psotrack.support import ARCHIVE_SUFFIX


@command(without=["json_path"])
def view(
    output: Output,
    tracks: Annotated[tuple[Path, ...], says(metavar="TRACKS... [SEQ]")],
    *,
    save: Annotated[Path | None, says(metavar="FILE.rrd")] = None,
    web: bool = False,
    max_size_mb: Annotated[Annotated[float, Meta(ge=1)] | None, says(metavar="MB")] = None,
    silhouettes: bool = False,
    onboard: bool = False,
    dictionary: Dictionary = "4x4_1000",
    extent: Extent,
) -> None:
    """Show TRACKS and their recording in space and time, in the viewer Rerun.

    SEQ is the recording, with its cameras, their images and its reference; the record beside TRACKS names it. Several
    files of TRACKS are compared: each has a colour. Rerun is an extra, pip install '.[view]' in the checkout
    of psotrack.

    \b
    Examples:
      psotrack view my_lab/results/tracks.csv
      psotrack view tracks.csv my_lab --save flight.rrd
      psotrack view swarm.csv lines.csv my_lab --web
      psotrack view my_lab --frames 250

    Options:
        save: write a file that `rerun FILE.rrd` shows, instead of opening a window.
        web: show a page for a browser on this computer, instead of a window.
        max_size_mb: largest size: images get smaller, then frames are left out. None: 5.8 per second, at most 1950.
        silhouettes: compute the silhouettes that are not stored, not only show stored ones.
        onboard: show the cameras on drones too, with the markers that they see.
    """
    from psotrack.show import viewer
    from psotrack.show.flights import first_instants, read_flight, split_sequence

    if save is not None and web:
        raise SettingsError("--web", expected="either --save or --web", found="both")
    check_suffix("--save", save, ".rrd")
    viewer.check_installed()
    if save is not None:
        output.refuse(save)
    elif not web:
        viewer.check_display()
    archive = tracks[-1].suffix == ARCHIVE_SUFFIX
    files, sequence = split_sequence((*tracks[:-1], opened_sequence(tracks[-1])) if archive else tracks)
    flight = read_flight(files, sequence, cameras=extent.cameras)
    if extent.num_frames is not None:
        flight = first_instants(flight, extent.num_frames)
    if onboard and (flight.recording is None or not flight.recording.onboard):
        raise SettingsError("--onboard", expected="a recording with cameras on drones", found="none")
    report, jobs = output.report, extent.jobs
    stored = extent.silhouettes
    content = viewer.ViewContent(
        silhouettes=viewer.find_silhouettes(flight, stored, make=silhouettes, jobs=jobs, report=report),
        onboard=onboard,
        dictionary=dictionary,
        max_bytes=None if max_size_mb is None else 1e6 * max_size_mb,
    )

    def write(path: Path) -> None:
        output.say(f"{viewer.write_flight(path, flight, content, jobs=jobs, report=report)}")

    if save is not None:
        write(save)
        return
    with tempfile.TemporaryDirectory(prefix="psotrack-") as folder:
        path = Path(folder) / "flight.rrd"
        write(path)
        if web:
            viewer.show_in_browser(path, _say_page)
        else:
            viewer.show_window(path)


def _say_page(page: str) -> None:
    click.echo(f"{page}  (Ctrl-C ends)")
    if sys.stdout.isatty():
        webbrowser.open(page)

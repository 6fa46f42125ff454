"""`psotrack view`: tracks, cameras and events in space and time, in the viewer Rerun."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from pathlib import Path

import click

from psotrack.cli.options import (
    FORCE,
    Extent,
    dictionary_option,
    extent_options,
    reporting,
)
from psotrack.cli.output import Output, check_suffix, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.cli.types import opened_sequence
from psotrack.errors import SettingsError
from psotrack.support import ARCHIVE_SUFFIX


@click.command(cls=HelpfulCommand)
@click.argument("tracks", nargs=-1, metavar="TRACKS... [SEQ]", type=click.Path(path_type=Path))
@click.option(
    "--save",
    type=click.Path(path_type=Path),
    metavar="FILE.rrd",
    help="Write a file that `rerun FILE.rrd` shows, instead of opening a window.",
)
@click.option("--web", is_flag=True, help="Show a page for a browser on this computer, instead of a window.")
@click.option(
    "--max-size",
    "max_size_mb",
    type=click.FloatRange(min=1),
    metavar="MB",
    help="Largest size: images get smaller, then frames are left out.  [default: 5.8 per second, at most 1950]",
)
@click.option(
    "--silhouettes",
    is_flag=True,
    help="Compute the silhouettes that are not stored.  [default: show stored ones]",
)
@click.option(
    "--onboard", is_flag=True, help="Show the cameras on drones too, with the markers that they see."
)
@dictionary_option()
@extent_options
@FORCE
@reporting
@pass_output
def view(
    output: Output,
    tracks: tuple[Path, ...],
    save: Path | None,
    web: bool,
    max_size_mb: float | None,
    silhouettes: bool,
    onboard: bool,
    dictionary: str,
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
    """
    from psotrack.show.flights import first_instants, read_flight, split_sequence
    from psotrack.show.viewer import (
        check_display,
        check_installed,
        find_silhouettes,
        show_in_browser,
        show_window,
    )

    if save is not None and web:
        raise SettingsError("--web", expected="either --save or --web", found="both")
    check_suffix("--save", save, ".rrd")
    check_installed()
    # These names need Rerun.
    from psotrack.show.viewer import ViewContent, write_flight

    if save is not None:
        output.refuse(save)
    elif not web:
        check_display()
    if not tracks:
        raise SettingsError("view", expected="TRACKS, SEQ or both", found="neither")
    archive = tracks[-1].suffix == ARCHIVE_SUFFIX
    files, sequence = split_sequence((*tracks[:-1], opened_sequence(tracks[-1])) if archive else tracks)
    flight = read_flight(files, sequence, cameras=extent.cameras)
    if extent.num_frames is not None:
        flight = first_instants(flight, extent.num_frames)
    if onboard and (flight.recording is None or not flight.recording.onboard):
        raise SettingsError("--onboard", expected="a recording with cameras on drones", found="none")
    report, jobs = output.report, extent.jobs
    content = ViewContent(
        silhouettes=find_silhouettes(flight, extent.silhouettes, make=silhouettes, jobs=jobs, report=report),
        onboard=onboard,
        dictionary=dictionary,
        max_bytes=None if max_size_mb is None else 1e6 * max_size_mb,
    )

    def write(path: Path) -> None:
        written = write_flight(path, flight, content, jobs=jobs, report=report)
        output.say(f"{written}")

    if save is not None:
        write(save)
        return
    with tempfile.TemporaryDirectory(prefix="psotrack-") as folder:
        path = Path(folder) / "flight.rrd"
        write(path)
        if web:
            show_in_browser(path, _say_page)
        else:
            show_window(path)


def _say_page(page: str) -> None:
    click.echo(f"{page}  (Ctrl-C ends)")
    if sys.stdout.isatty():
        webbrowser.open(page)

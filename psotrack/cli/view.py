"""`psotrack view`: tracks, cameras and events in space and time, in the viewer Rerun."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

import click

from psotrack.cli.options import (
    CACHE,
    CAMERAS,
    FORCE,
    JOBS,
    SequencePath,
    cache_folder,
    camera_names,
    dictionary_option,
    frames_option,
    reporting,
)
from psotrack.cli.output import report_to
from psotrack.errors import SettingsError
from psotrack.support import refuse_to_overwrite

if TYPE_CHECKING:
    from psotrack.flights import TrackedFlight
    from psotrack.viewer import WrittenFlight


@click.command()
@click.argument("tracks", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--sequence",
    metavar="SEQ",
    type=SequencePath(path_type=Path),
    help="The recording: its cameras with their images, and its reference.",
)
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
@CAMERAS
@frames_option
@CACHE
@JOBS
@FORCE
@reporting
def view(
    tracks: tuple[Path, ...],
    sequence: Path | None,
    save: Path | None,
    web: bool,
    max_size_mb: float | None,
    silhouettes: bool,
    onboard: bool,
    dictionary: str,
    cameras: str | None,
    num_frames: int | None,
    cache: Path | None,
    jobs: int | None,
    force: bool,
    quiet: bool,
) -> None:
    """Show TRACKS and their recording in space and time, in the viewer Rerun.

    Several files of TRACKS are compared: each has a colour. Rerun is an extra, pip install '.[view]' in the checkout
    of psotrack.

    \b
    Examples:
      psotrack view tracks.csv --sequence data/Simulated_Data/S02_D4_A
      psotrack view tracks.csv --sequence data/Simulated_Data/S02_D4_A --save flight.rrd
      psotrack view swarm.csv lines.csv --sequence flight --web
      psotrack view --sequence flight --frames 250
    """
    from psotrack.flights import first_instants, read_flight
    from psotrack.viewer import (
        check_display,
        check_installed,
        find_silhouettes,
        show_in_browser,
        show_window,
    )

    if save is not None and web:
        raise SettingsError("--web", expected="either --save or --web", found="both")
    if save is not None and save.suffix != ".rrd":
        raise SettingsError("--save", expected="a file that ends in .rrd", found=save.name)
    check_installed()
    # These names need Rerun.
    from psotrack.viewer import ViewContent, write_flight

    if save is not None:
        refuse_to_overwrite(save, force)
    elif not web:
        check_display()
    flight = read_flight(tracks, sequence, cameras=camera_names(cameras))
    if num_frames is not None:
        flight = first_instants(flight, num_frames)
    if onboard and (flight.recording is None or not flight.recording.onboard):
        raise SettingsError("--onboard", expected="a recording with cameras on drones", found="none")
    report = report_to(quiet)
    content = ViewContent(
        silhouettes=find_silhouettes(flight, cache_folder(cache), make=silhouettes, jobs=jobs, report=report),
        onboard=onboard,
        dictionary=dictionary,
        max_bytes=None if max_size_mb is None else 1e6 * max_size_mb,
    )

    def write(path: Path, name: str) -> None:
        written = write_flight(path, flight, content, jobs=jobs, report=report)
        if not quiet:
            click.echo(_sentence(name, flight, content.silhouettes is not None, written))

    if save is not None:
        write(save, str(save))
        return
    with tempfile.TemporaryDirectory(prefix="psotrack-") as folder:
        path = Path(folder) / "flight.rrd"
        write(path, flight.name)
        if web:
            show_in_browser(path, _say_page)
        else:
            show_window(path)


def _say_page(page: str) -> None:
    click.echo(f"{page}  (Ctrl-C ends)")
    if sys.stdout.isatty():
        webbrowser.open(page)


def _sentence(name: str, flight: TrackedFlight, has_silhouettes: bool, written: WrittenFlight) -> str:
    """What was made smaller or left out, in one line."""
    parts = [f"{name}: {written.num_bytes / 1e6:.1f} MB"]
    if written.plan.num_images:
        smallest = max(written.plan.reduction.values())
        frames = "every frame" if written.plan.step == 1 else f"1 frame in {written.plan.step}"
        size = "full size" if smallest == 1 else f"1/{smallest} of the width and height"
        parts.append(f"{written.plan.num_images} images ({frames}, {size})")
        if not has_silhouettes:
            parts.append("no silhouettes are stored; --silhouettes computes them")
    elif flight.recording is None:
        parts.append("--sequence shows the cameras, too")
    return ", ".join(parts)

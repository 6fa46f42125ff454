"""`psotrack view`, `report` and `overlay`: tracks to look at, in a viewer, on a page and in videos."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import Annotated, Literal

import click
from msgspec import Meta

from psotrack import sweeps
from psotrack.cli.commands import command
from psotrack.cli.options import Dictionary, Extent, Jobs, SeqOfTracks, sequence_of
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import opened_sequence, says
from psotrack.errors import SettingsError, errors_name
from psotrack.show import flights
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

    if save is not None and web:
        raise SettingsError("--web", expected="either --save or --web", found="both")
    check_suffix("--save", save, ".rrd")
    viewer.check_installed()
    if save is not None:
        output.refuse(save)
    elif not web:
        viewer.check_display()
    archive = tracks[-1].suffix == ARCHIVE_SUFFIX
    files, sequence = flights.split_sequence(
        (*tracks[:-1], opened_sequence(tracks[-1])) if archive else tracks
    )
    flight = flights.read_flight(files, sequence, cameras=extent.cameras)
    if extent.num_frames is not None:
        flight = flights.first_instants(flight, extent.num_frames)
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


WITH_TABLE = says(heading="With --table")


@command(without=["json_path"])
def report(
    output: Output,
    source: Path,
    sequence: SeqOfTracks = None,
    *,
    out: Path | None = None,
    compare: Annotated[
        tuple[Path, ...], says(multiple=True, metavar="TRACKS", type=click.Path(path_type=Path))
    ] = (),
    no_pictures: bool = False,
    table: Annotated[
        Literal["text", "markdown", "latex", "csv"] | None, says(is_flag=False, flag_value="text")
    ] = None,
    rows: Annotated[str, WITH_TABLE] = "sequence",
    columns: Annotated[str | None, WITH_TABLE] = None,
    value: Annotated[str, WITH_TABLE] = "mean_error_m",
    scale: Annotated[float, WITH_TABLE] = 1.0,
    jobs: Jobs = None,
) -> None:
    """Write one HTML page about SOURCE, a file of tracks, or print a table of SOURCE, the folder of a sweep.

    With SEQ, the recording of the tracks, which the record beside the tracks names, the page has errors, cameras, and
    pictures of events. The page needs no network and no other file: a browser opens it by a double click.

    In a table of a sweep, the end of a column's name is enough if no other column ends with it: particles is
    settings.swarm.particles.

    \b
    Examples:
      psotrack report my_lab/results/tracks.csv
      psotrack report tracks.csv my_lab --compare lines.csv --out report.html
      psotrack report results --table --rows sequence,particles --columns iterations --scale 1000

    Options:
        out: page to write; it ends in .html. None: beside SOURCE, with the same name.
        compare: further tracks of the same flight to show beside; may be repeated.
        no_pictures: show events without pictures, which need the videos of SEQ.
        table: print a table of a sweep's results instead: mean +- standard deviation over runs.  [without a value:
            text]
        rows: columns of the results, with commas between them, that label the rows.
        columns: columns of the results that label the table's columns. None: method; sequence if --rows names method.
        value: column of the numbers in the table.
        scale: factor of the numbers; 1000 turns m into mm.
    """
    from psotrack import api

    if table is not None:
        click.echo(_table(source, table, rows, columns, value, scale))
        return
    written = api.report(
        [source, *compare],
        out,
        recording=sequence,
        pictures=not no_pictures,
        jobs=jobs,
        force=output.force,
        progress=output.report,
    )
    output.say(f"{written}")


def _table(folder: Path, layout: str, rows: str, columns: str | None, value: str, scale: float) -> str:
    """A table of the results of a sweep."""
    rows_by = [name for name in rows.split(",") if name]
    if columns is None:
        columns = next((name for name in ("method", "sequence") if name not in rows_by), "")
    columns_by = [name for name in columns.split(",") if name]
    with errors_name(folder):
        shown = sweeps.pivot(
            sweeps.Store(folder).rows(), rows_by=rows_by, columns_by=columns_by, value=value, scale=scale
        )
    return sweeps.render_table(shown, layout).rstrip("\n")


@command(without=["json_path"])
def overlay(
    output: Output,
    tracks: Path,
    sequence: SeqOfTracks = None,
    *,
    out: Path | None = None,
    mosaic: bool = False,
    scale: Annotated[float, Meta(gt=0, le=4)] = 1.0,
    extent: Extent,
) -> None:
    """Draw TRACKS into the videos of SEQ: boxes, names, trails, 90 % ellipses and time.

    SEQ is the recording of TRACKS; the record beside TRACKS names it. Finished videos of the same TRACKS are kept, so
    that a run that was interrupted can be continued.

    \b
    Examples:
      psotrack overlay my_lab/results/tracks.csv
      psotrack overlay tracks.csv my_lab --out videos --mosaic
      psotrack overlay tracks.csv my_lab --out videos --cameras cam1,cam2 --scale 0.5

    Options:
        out: folder of the videos, CAMERA.mp4. None: overlay beside TRACKS.
        mosaic: write one video of all cameras with a map from above, mosaic.mp4, instead of a video per camera.
        scale: size of the videos per size of the cameras' videos; the mosaic is 1920 pixels wide.
    """
    from psotrack import api

    written = api.overlay(
        tracks,
        out,
        recording=sequence_of(tracks, sequence),
        cameras=extent.cameras,
        num_frames=extent.num_frames,
        jobs=extent.jobs,
        progress=output.report,
        mosaic=mosaic,
        scale=scale,
        force=output.force,
    )
    output.say(f"{written}")

"""`psotrack init`: write the `recording.toml` of the files in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from psotrack.cli.options import BODIES, FORCE, JSON, QUIET, out_option
from psotrack.cli.output import Output, check_suffix, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.cli.types import SequencePath, Size
from psotrack.errors import SettingsError

if TYPE_CHECKING:
    from psotrack.recordings.datasets import Draft


@click.command("init", cls=HelpfulCommand)
@click.argument("folder", type=SequencePath(path_type=Path))
@click.option(
    "--calibration",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Rig file, of any format that `calibrate convert` reads.  [default: the one in FOLDER]",
)
@click.option(
    "--units",
    "--unit",
    "unit",
    type=click.Choice(["m", "cm", "mm"]),
    help="Unit of the lengths in the rig file; needed if the format leaves the unit open.",
)
@click.option(
    "--match",
    "matches",
    multiple=True,
    metavar="CAMERA=FILE",
    help="FILE of FOLDER, or address of a stream, that belongs to CAMERA; may be repeated.",
)
@click.option(
    "--leave-out", multiple=True, metavar="FILE", help="File of FOLDER that is not used; may be repeated."
)
@click.option("--fps", type=float, help="Frames per second of cameras that have images or detections only.")
@click.option(
    "--size",
    "size_wh",
    type=Size(),
    metavar="W,H",
    help="Size of the images of cameras that have detections only, if the rig file does not state it.",
)
@out_option("[default: FOLDER/recording.toml]", metavar="FILE")
@click.option(
    "--show",
    "shown",
    is_flag=True,
    help="Show what the recording FOLDER contains, and check its files, of videos the last frame; write nothing.",
)
@BODIES
@FORCE
@QUIET
@JSON
@pass_output
def init(output: Output, folder: Path, out: Path | None, shown: bool, **chosen: Any) -> None:
    """Write the recording.toml of the videos, images and detections in FOLDER, or show what a recording contains.

    Files belong to cameras by their names: cam1i_s.avi to cam1, cam_60881257.mp4 to 60881257, gopro3_clip.MP4 to
    GoPro 3. Nothing is guessed: where a name does not say whose a file is, the command asks for --match or --leave-out.
    Detections, frame times (frame,time_s), images of what is ignored (a name with "ignore" or "mask"), references and
    marker corners are found by name and content.

    Without a rig file, the cameras have the names of their files, and no place yet.

    With --show, FOLDER is a recording that is there already: a recording.toml or its folder, a folder of the DPJAIT
    dataset, or an archive.

    \b
    Examples:
      psotrack init my_lab
      psotrack init my_lab --calibration rig.toml --match left=GX010123.MP4 --leave-out test.mp4
      psotrack init my_lab --calibration rig.toml --body cf1=M1,M2,M3,M4 --body cf2
      psotrack init data/Simulated_Data/S02_D4_A --show
    """
    from psotrack.recordings import RECORDING_FILE

    if shown:
        _show(output, folder, chosen["bodies"])
    else:
        _draft(output, folder, out or folder / RECORDING_FILE, **chosen)


def _show(output: Output, sequence: Path, bodies: dict[str, tuple[str, ...]]) -> None:
    """Show a recording, and check its files."""
    from psotrack.recordings import check_end, inventory_table
    from psotrack.recordings.datasets import open_recording

    recording = open_recording(sequence, bodies=bodies)
    for video in recording.videos.values():
        check_end(video)
    recording.check_detections(recording.detections)
    if recording.marker_corners is not None:
        from psotrack.inside_out import read_marker_table

        read_marker_table(recording.marker_corners)
    content = recording.to_dict()
    output.json(content)
    output.show(inventory_table(content), wide=True)


def _draft(
    output: Output,
    folder: Path,
    path: Path,
    *,
    calibration: Path | None,
    unit: Literal["m", "cm", "mm"] | None,
    matches: tuple[str, ...],
    leave_out: tuple[str, ...],
    fps: float | None,
    size_wh: tuple[int, int] | None,
    bodies: dict[str, tuple[str, ...]],
) -> None:
    """Write the file of a recording."""
    from psotrack.errors import check_positive
    from psotrack.recordings import (
        inventory_table,
        recording_file_text,
        write_recording_file,
    )
    from psotrack.recordings.datasets import DraftOptions, draft_recording

    check_suffix("--out", path, ".toml")
    if fps is not None:
        check_positive("--fps", fps)
    output.refuse(path)
    options = DraftOptions(
        calibration, unit, [_pair(match) for match in matches], leave_out, fps, size_wh, bodies
    )
    draft = draft_recording(folder, path, options)
    content = draft.recording.to_dict()
    kept = _keep_older(path, recording_file_text(draft.content))
    write_recording_file(path, draft.content)
    output.json(_content(path, draft, content))
    output.show(inventory_table(content), wide=True)
    output.say(*_lines(path, draft), *kept)


def _keep_older(path: Path, text: str) -> list[str]:
    """Keep the file that is replaced, which may have been edited, beside the new one; returns a line that says so."""
    from psotrack.support import atomic_write

    if not path.is_file() or path.read_bytes() == text.encode():
        return []
    older = path.with_name(f"{path.name}.bak")
    with atomic_write(older) as temporary:
        temporary.write_bytes(path.read_bytes())
    return [f"{older}: the file as it was; copy what you had written into it"]


def _pair(match: str) -> tuple[str, str]:
    camera, equals, file = match.partition("=")
    if not (camera and equals and file):
        raise SettingsError("--match", expected="CAMERA=FILE", found=match)
    return camera, file


def _content(path: Path, draft: Draft, content: dict[str, Any]) -> dict[str, Any]:
    """The draft as JSON."""
    return {
        "recording": str(path),
        "calibration": draft.content.calibration,
        **content,
        "without_files": list(draft.without_files),
        "unused": [str(file) for file in draft.unused],
    }


def _lines(path: Path, draft: Draft) -> list[str]:
    """What a user needs to know of a draft."""
    lines = []
    if draft.without_files:
        lines.append(f"cameras without any file, left out: {', '.join(draft.without_files)}")
    if draft.unused:
        lines.append(f"files that are not used: {', '.join(file.name for file in draft.unused)}")
    unplaced = [each.name for each in draft.recording.cameras if each.camera is None]
    if unplaced:
        lines.append(
            f"cameras without place: {', '.join(unplaced)}; `psotrack calibrate rig` makes the rig file, then "
            f"`psotrack init {path.parent} --calibration rig.toml --force`"
        )
    count = len(draft.content.cameras)
    return [*lines, f"{path}: {count} camera{'s' if count > 1 else ''}"]

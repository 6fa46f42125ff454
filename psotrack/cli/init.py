"""`psotrack init`: write the `recording.toml` of the files in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from psotrack.cli.options import BODIES, FORCE, JSON, QUIET, Size
from psotrack.cli.output import output_json, print_inventory, print_line
from psotrack.errors import SettingsError

if TYPE_CHECKING:
    from psotrack.recordings.datasets import Draft


@click.command("init")
@click.argument("folder", type=click.Path(path_type=Path))
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
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="FILE", help="[default: FOLDER/recording.toml]"
)
@BODIES
@FORCE
@QUIET
@JSON
def init(
    folder: Path,
    calibration: Path | None,
    unit: Literal["m", "cm", "mm"] | None,
    matches: tuple[str, ...],
    leave_out: tuple[str, ...],
    fps: float | None,
    size_wh: tuple[int, int] | None,
    out: Path | None,
    bodies: dict[str, tuple[str, ...]],
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Write the recording.toml of the videos, images and detections in FOLDER, which other commands take as SEQ.

    Files belong to cameras by their names: cam1i_s.avi to cam1, cam_60881257.mp4 to 60881257, gopro3_clip.MP4 to
    GoPro 3. Nothing is guessed: where a name does not say whose a file is, the command asks for --match or --leave-out.
    Detections, frame times (frame,time_s), images of what is ignored (a name with "ignore" or "mask"), references and
    marker corners are found by name and content.

    Without a rig file, the cameras have the names of their files, and no place yet.

    \b
    Examples:
      psotrack init flight
      psotrack init flight --calibration rig.toml
      psotrack init flight --calibration rig.toml --match left=GX010123.MP4 --leave-out test.mp4
      psotrack init flight --calibration rig.toml --body cf1=M1,M2,M3,M4 --body cf2
    """
    from psotrack.errors import check_positive
    from psotrack.recordings import (
        RECORDING_FILE,
        inventory_table,
        recording_file_text,
        write_recording_file,
    )
    from psotrack.recordings.datasets import DraftOptions, draft_recording
    from psotrack.support import refuse_to_overwrite

    path = out or folder / RECORDING_FILE
    if path.suffix.lower() != ".toml":
        raise SettingsError("--out", expected="a file that ends in .toml", found=path.name)
    if fps is not None:
        check_positive("--fps", fps)
    refuse_to_overwrite(path, force)
    options = DraftOptions(
        calibration, unit, [_pair(match) for match in matches], leave_out, fps, size_wh, bodies
    )
    draft = draft_recording(folder, path, options)
    content = draft.recording.to_dict()
    kept = _keep_older(path, recording_file_text(draft.content))
    write_recording_file(path, draft.content)
    output_json(json_path, _content(path, draft, content), force)
    if not quiet and json_path != Path("-"):
        print_inventory(inventory_table(content))
    for line in [*_lines(path, draft), *kept]:
        print_line(quiet, json_path, line)


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
    unplaced = draft.recording.unplaced
    if unplaced:
        lines.append(
            f"cameras without place: {', '.join(unplaced)}; `psotrack calibrate rig` makes the rig file, then "
            f"`psotrack init {path.parent} --calibration rig.toml --force`"
        )
    count = len(draft.content.cameras)
    return [*lines, f"{path}: {count} camera{'s' if count > 1 else ''}"]

"""`psotrack init`: write the `recording.toml` of the files in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from psotrack.cli.commands import command
from psotrack.cli.options import Bodies
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import SequencePath, Words, says


def _pair(match: str) -> tuple[str, str]:
    """Camera and file of --match."""
    camera, _, file = match.partition("=")
    if not (camera and file):
        raise ValueError
    return camera, file


@command(without=["progress"])
def init(
    output: Output,
    folder: Annotated[Path, says(type=SequencePath(path_type=Path))],
    *,
    calibration: Annotated[Path | None, says(metavar="FILE")] = None,
    unit: Annotated[Literal["m", "cm", "mm"] | None, says(flag="units")] = None,
    match: Annotated[
        tuple[tuple[str, str], ...], says(multiple=True, type=Words("CAMERA=FILE", "CAMERA=FILE", _pair))
    ] = (),
    leave_out: Annotated[tuple[str, ...], says(multiple=True, metavar="FILE", type=str)] = (),
    fps: Annotated[float, Meta(gt=0, le=1e6)] | None = None,
    size_wh: Annotated[tuple[int, int] | None, says(flag="size", metavar="W,H")] = None,
    out: Annotated[Path | None, says(metavar="FILE")] = None,
    show: bool = False,
    bodies: Bodies,
) -> None:
    """Write the recording.toml of the videos, images and detections in FOLDER, or show what a recording contains.

    Files belong to cameras by their names: cam1i_s.avi to cam1, cam_60881257.mp4 to 60881257, gopro3_clip.MP4 to
    GoPro 3. Nothing is guessed: where names do not say whose files are, an error names the files, and --match and
    --leave-out say it.
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

    Options:
        calibration: rig file, of any format that `calibrate convert` reads. None: the one in FOLDER.
        unit: unit of the lengths in the rig file; needed if the format leaves the unit open.
        match: FILE of FOLDER, or address of a stream, that belongs to CAMERA; may be repeated.
        leave_out: file of FOLDER that is not used; may be repeated.
        fps: frames per second of cameras that have images or detections only.
        size_wh: size of the images of cameras that have detections only, if the rig file does not state it.
        out: file to write. None: FOLDER/recording.toml.
        show: show what the recording FOLDER contains, and check its files, of videos the last frame; write nothing.
    """
    from psotrack.recordings import RECORDING_FILE, inventory_table
    from psotrack.recordings.datasets import DraftOptions, draft_recording

    if show:
        _show(output, folder, bodies)
        return
    out = out or folder / RECORDING_FILE
    check_suffix("--out", out, ".toml")
    output.refuse(out)
    options = DraftOptions(
        calibration, unit=unit, match=match, leave_out=leave_out, fps=fps, size_wh=size_wh, bodies=bodies
    )
    draft = draft_recording(folder, out, options)
    older = draft.write()
    content = draft.to_dict()
    output.json(content)
    output.show(inventory_table(content), wide=True)
    output.say(*str(draft).splitlines())
    if older is not None:
        output.say(f"{older}: the file as it was; copy what you had written into it")


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

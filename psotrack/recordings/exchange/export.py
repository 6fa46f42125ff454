"""Export of tracks into the formats of other programs, whole or not at all."""

from __future__ import annotations

from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

from psotrack.errors import OutputError, SettingsError
from psotrack.recordings.exchange.c3d_files import write_c3d_tracks
from psotrack.recordings.exchange.formats import FORMATS, Footage, lost_quantities, seen_only
from psotrack.recordings.exchange.json_files import write_json_tracks
from psotrack.recordings.exchange.kitti_files import write_kitti
from psotrack.recordings.exchange.mcap_files import write_mcap
from psotrack.recordings.exchange.mot_files import write_mot_folder, write_mot_positions
from psotrack.support import Report, atomic_write, no_progress, refuse_to_overwrite
from psotrack.trajectories import Trajectories, write_trajectories
from psotrack.trajectories.tum import write_tum


def export_tracks(
    trajectories: Trajectories,
    to: str,
    out: Path | str,
    *,
    footage: Footage | None = None,
    force: bool = False,
    report: Report = no_progress,
) -> tuple[str, ...]:
    """Write tracks in a format of other programs, as a file or as a folder; `read_tracks` reads them again.

    tum: a folder with a file per drone, or one file that ends in .tum for one drone. kitti: a folder. mot: a file of
    positions that ends in .txt, or with a recording a folder with positions and with boxes per camera. mcap: a file, or
    the folder of a bag. c3d, csv, parquet, json: a file.

    Args:
        trajectories: the tracks.
        to: name of the format, a key of `FORMATS`.
        out: path of the file or of the folder.
        footage: the recording, for the boxes of `mot` and the cameras and images of `mcap`; other formats ignore it.
        force: replace an existing file, or an existing folder that contains only what the format writes.
        report: shows the progress of images and boxes.

    Returns:
        What the tracks have and the format cannot hold, as noun phrases; empty if nothing is lost.

    Raises:
        SettingsError: the format is unknown, the name of the output does not fit the format, or the libraries of mcap
            are not installed.
        InputError: no drone is ever seen, or the tracks cannot be written in this format.
        OutputError: the output exists and `force` is not set, or it cannot be written; an older one is unchanged.
    """
    if to not in FORMATS:
        raise SettingsError("to", expected=f"one of {', '.join(FORMATS)}", found=to)
    out = Path(out)
    is_folder = _is_folder(trajectories, to, out, footage)
    _check_replaceable(out, to, is_folder, force)
    lost = lost_quantities(trajectories, to)
    if to in ("csv", "parquet"):
        write_trajectories(out, trajectories, force=force)
        return tuple(lost)
    seen, kept = seen_only(trajectories)
    if footage is not None and footage.size_m is not None:
        footage = replace(footage, size_m=footage.size_m[kept])
    with atomic_write(out) as temporary:
        if to == "json":
            write_json_tracks(temporary, trajectories)
        elif to == "c3d":
            write_c3d_tracks(temporary, trajectories)
        elif to == "kitti":
            write_kitti(temporary, seen)
        elif to == "mcap":
            lost += write_mcap(temporary, seen, footage, report)
        elif to == "tum":
            one = replace(seen, drones=(temporary.stem,)) if not is_folder else seen
            write_tum(temporary if is_folder else temporary.parent, one)
        elif is_folder:
            assert footage is not None
            lost += write_mot_folder(temporary, seen, footage, report)
        else:
            lost += ["boxes, which need SEQ", "the rate"]
            write_mot_positions(temporary, seen)
    return tuple(lost)


def _is_folder(trajectories: Trajectories, to: str, out: Path, footage: Footage | None) -> bool:
    """Whether the output is a folder; raise `SettingsError` if its name does not fit the format."""
    suffix = FORMATS[to].suffix
    if not FORMATS[to].is_folder:
        _check_suffix(out, out.suffix == suffix, f"a file that ends in {suffix}")
        return False
    is_file = out.suffix.lower() in {each.suffix for each in FORMATS.values() if each.suffix}
    if to == "mot":
        with_boxes = footage is not None
        expected = (
            "a folder, for positions and boxes"
            if with_boxes
            else "a file that ends in .txt, for positions alone"
        )
        remedy = "" if with_boxes else "name SEQ for a folder with boxes per camera"
        _check_suffix(out, not is_file if with_boxes else out.suffix == suffix, expected, remedy)
        return with_boxes
    expected = "a folder" if not suffix else f"a folder, or a file that ends in {suffix}"
    _check_suffix(out, not is_file or out.suffix == suffix != "", expected)
    if to == "tum" and is_file:
        count = int(trajectories.seen.any(axis=0).sum())
        _check_suffix(
            out, count <= 1, f"a folder, because a TUM file holds one drone and the tracks have {count}"
        )
    return not is_file


def _check_suffix(out: Path, fits: bool, expected: str, remedy: str = "") -> None:
    if not fits:
        raise SettingsError("--out", expected=expected, found=out.name, remedy=remedy)


def _check_replaceable(out: Path, to: str, is_folder: bool, force: bool) -> None:
    """Refuse to replace what exists without `force`, and a folder that holds anything else than the format writes."""
    refuse_to_overwrite(out, force)
    if not is_folder or not out.exists():
        return
    entries = [path.name for path in out.iterdir()] if out.is_dir() else [out.name]
    foreign = [name for name in entries if not any(fnmatch(name, entry) for entry in FORMATS[to].entries)]
    if foreign:
        raise OutputError(
            out,
            expected=f"a folder that contains only what the format {to} writes",
            found=sorted(foreign)[0],
            remedy="name another folder",
        )

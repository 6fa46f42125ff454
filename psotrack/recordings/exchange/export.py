"""Export of tracks into the formats of other programs, whole or not at all."""

from __future__ import annotations

from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings.exchange.camera_boxes import Footage
from psotrack.recordings.exchange.formats import FORMATS, NAMES, PHRASES, STATUS, TIMES, TrackFormat
from psotrack.recordings.exchange.timed_paths import interval_s, own_interval_s
from psotrack.support import Report, atomic_write, no_progress, refuse_to_overwrite
from psotrack.trajectories import Status, Trajectories


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

    tum: a folder with a file per drone, or one file that ends in .tum or .txt for one drone. kitti: a folder. mot: a
    file of positions that ends in .txt, or with a recording a folder with positions and with boxes per camera. c3d,
    mcap, csv, parquet, json: a file.

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
    form, out = FORMATS[to], Path(out)
    kept = np.flatnonzero(trajectories.seen.any(axis=0))
    _check_name(out, to, len(kept), footage)
    _check_replaceable(out, to, force)
    lost = _lost_quantities(trajectories, form)
    if TIMES in lost and (own_s := own_interval_s([trajectories])):
        trajectories = replace(trajectories, frame=np.round(trajectories.time_s / own_s).astype(np.int64))
        lost = _lost_quantities(trajectories, form)
    if not form.needs_all:
        if not len(kept):
            raise InputError("tracks", expected="a drone that is seen in some frame", found="none")
        trajectories = trajectories.of_drones(kept.tolist())
        if footage is not None and footage.size_m is not None:
            footage = replace(footage, size_m=footage.size_m[kept])
    with atomic_write(out) as temporary:
        lost += form.write(temporary, trajectories, footage, report)
    return tuple(lost)


def _lost_quantities(trajectories: Trajectories, form: TrackFormat) -> list[str]:
    """What these trajectories have and the format cannot hold, as noun phrases."""
    frame, time_s = trajectories.frame, trajectories.time_s
    values = trajectories.quantities()
    known = {
        NAMES: trajectories.drones != tuple(str(k + 1) for k in range(trajectories.num_drones)),
        # Frame numbers and a rate say the same as times of equal distance.
        TIMES: len(frame) > 0 and np.abs(time_s - frame * interval_s(trajectories)).max() > 1e-6,
        **{name: bool(np.isfinite(values.get(key, np.nan)).any()) for name, key in PHRASES.items()},
        STATUS: bool((values.get("status", np.array(Status.LOST)) == Status.COASTING).any()),
    }
    lost = [name for name, is_known in known.items() if is_known and name not in form.holds]
    if STATUS in form.holds:
        return lost
    seen = trajectories.seen
    hidden = int((np.isfinite(trajectories.position_m).all(axis=-1) & ~seen).sum())
    if hidden:
        lost.append(f"{hidden} positions of lost drones")
    never = [name for name, each in zip(trajectories.drones, seen.T, strict=True) if not each.any()]
    if never and not form.needs_all:
        lost.append(f"drones that are never seen ({', '.join(never)})")
    return lost


def _check_name(out: Path, to: str, num_seen: int, footage: Footage | None) -> None:
    """Raise `SettingsError` for a name of the output that does not fit the format."""
    form = FORMATS[to]
    is_file = out.suffix in form.suffixes
    is_folder = not any(out.suffix.lower() in each.suffixes for each in FORMATS.values())
    expected = " or ".join(form.suffixes)
    remedy = ""
    if to == "mot" and footage is not None:
        expected, fits = "a folder, for positions and boxes", is_folder
    elif to == "mot":
        expected, fits = f"a file that ends in {expected}, for positions alone", is_file
        remedy = "name SEQ for a folder with boxes per camera"
    elif not form.entries:
        expected, fits = f"a file that ends in {expected}", is_file
    else:
        file = f", or a file that ends in {expected}" if form.suffixes else ""
        expected, fits = f"a folder{file}", is_folder or is_file
        if is_file and form.is_of_one and num_seen > 1:
            expected = f"a folder, because a {to.upper()} file holds one drone and the tracks have {num_seen}"
            fits = False
    if not fits:
        raise SettingsError("--out", expected=expected, found=out.name, remedy=remedy)


def _check_replaceable(out: Path, to: str, force: bool) -> None:
    """Refuse to replace what exists without `force`, and a folder that holds anything else than the format writes."""
    form = FORMATS[to]
    refuse_to_overwrite(out, force)
    if out.suffix in form.suffixes or not out.exists():
        return
    entries = [path.name for path in out.iterdir()] if out.is_dir() else [out.name]
    foreign = [name for name in entries if not any(fnmatch(name, entry) for entry in form.entries)]
    if foreign:
        raise OutputError(
            out,
            expected=f"a folder that contains only what the format {to} writes",
            found=sorted(foreign)[0],
            remedy="name another folder",
        )

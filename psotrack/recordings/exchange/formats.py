"""The formats of tracks: what each can hold, how it is written, and how a file or a folder of it is read.

A format is written whole or not at all. In C3D (see `recordings.c3d`), a drone is one point, in millimetres, in every
frame from frame 0 on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from psotrack.errors import InputError, OutputError, SettingsError, errors_name
from psotrack.recordings import Recording
from psotrack.recordings.exchange.benchmark_files import (
    POSES,
    TRACKS,
    WORLD,
    read_kitti,
    read_mot_positions,
    write_kitti,
    write_mot,
)
from psotrack.recordings.exchange.camera_boxes import Footage
from psotrack.recordings.exchange.json_files import read_json_tracks, write_json_tracks
from psotrack.recordings.exchange.mcap_files import read_mcap, write_mcap
from psotrack.recordings.exchange.timed_paths import interval_s, joined, on_clock, own_interval_s
from psotrack.recordings.mocap import Markers, read_c3d, write_c3d
from psotrack.support import (
    Report,
    are_numbers,
    atomic_write,
    check_kind,
    first_line,
    no_progress,
    number_words,
    refuse_to_overwrite,
)
from psotrack.trajectories import Status, Trajectories, read_trajectories, write_trajectories
from psotrack.trajectories.tum import read_tum, tum_text, write_tum

#: Rates that differ by less than this share are one rate: C3D has float32.
_ONE_RATE = 1e-3


def write_c3d_tracks(path: Path, trajectories: Trajectories, footage: Footage | None, report: Report) -> None:
    """Write one point per drone; frames in which a drone is not seen have a residual of -1.

    Raises:
        SettingsError: there are more frames than the format can hold.
        OutputError: the file cannot be written.
    """
    frames = int(trajectories.frame[-1]) + 1
    position_m = np.full((frames, trajectories.num_drones, 3), np.nan)
    position_m[trajectories.frame] = np.where(trajectories.seen[..., None], trajectories.position_m, np.nan)
    write_c3d(path, Markers(trajectories.drones, position_m, 1 / interval_s(trajectories)))


def read_c3d_tracks(path: Path, recording: Recording | None) -> Trajectories:
    """Each point of the file as a drone; frame k of the file is instant k of the recording, if it has the same rate.

    Raises:
        InputError: the file cannot be read, or two points have one label.
    """
    markers = read_c3d(path)
    labels = [label for label in markers.labels if markers.labels.count(label) > 1]
    if labels:
        raise InputError(path, expected="points with different labels", found=f"{labels[0]} twice")
    frame = markers.frame
    read = Trajectories(frame, frame / markers.rate_hz, markers.labels, markers.position_m)
    if recording is None or abs(markers.rate_hz / recording.fps - 1) > _ONE_RATE:
        return read
    time_s = recording.timeline().time_s
    read = read.at_frames(frame[frame < len(time_s)])
    return replace(read, time_s=time_s[read.frame].astype(np.float64))


#: What some formats cannot hold, as messages name it: quantities of `Trajectories`, and what is no such quantity.
PHRASES = {
    "orientations": "orientation_wxyz",
    "covariances": "covariance_m2",
    "covariances without constant errors": "relative_covariance_m2",
    "velocities": "velocity_m_s",
    "fitness": "fitness",
    "numbers of cameras": "num_cameras",
}
NAMES, TIMES, STATUS = "names of drones", "times", "status"
_POSES = frozenset({NAMES, TIMES, "orientations"})
_ALL = frozenset({NAMES, TIMES, *PHRASES, STATUS})
#: Numbers per line of a TUM file and of a KITTI file; more than 6 with commas are MOT.
_TUM, _KITTI = 8, 12
#: Writes tracks to a path, and returns what is missing in it as noun phrases, if there is any.
Write = Callable[[Path, Trajectories, Footage | None, Report], list[str] | None]
Read = Callable[[Path, Recording | None], Trajectories]


@dataclass(frozen=True)
class TrackFormat:
    """A format of tracks.

    Attributes:
        holds: which quantities the format holds.
        write: writes a file, or a folder where the path has none of the endings.
        suffixes: endings of a file's name; none where the format is always a folder.
        entries: names, or patterns of names, of what a folder of the format contains: a folder with anything else is
            not replaced. None where the format is always a file.
        is_of_one: whether a file holds one drone only, and its name is the drone's.
        needs_all: whether drones that are never seen are written, too.
    """

    holds: frozenset[str]
    write: Write
    suffixes: tuple[str, ...] = ()
    entries: tuple[str, ...] = ()
    is_of_one: bool = False
    needs_all: bool = False


def _write_tum(path: Path, tracks: Trajectories, footage: Footage | None, report: Report) -> None:
    if path.suffix in FORMATS["tum"].suffixes:
        path.write_text(tum_text(tracks, 0), encoding="utf-8")
    else:
        write_tum(path, tracks)


def _write_table(path: Path, tracks: Trajectories, footage: Footage | None, report: Report) -> None:
    write_trajectories(path, tracks)


#: The formats by name.
FORMATS = {
    "tum": TrackFormat(_POSES, _write_tum, (".tum", ".txt"), ("*.tum",), is_of_one=True),
    "kitti": TrackFormat(_POSES, write_kitti, entries=("poses", "sequences")),
    "mot": TrackFormat(frozenset(), write_mot, (".txt",), ("3d", "gt", "trackers")),
    "c3d": TrackFormat(frozenset({NAMES}), write_c3d_tracks, (".c3d",), needs_all=True),
    "mcap": TrackFormat(_POSES | {"covariances"}, write_mcap, (".mcap",)),
    "csv": TrackFormat(_ALL, _write_table, (".csv",), needs_all=True),
    "parquet": TrackFormat(_ALL, _write_table, (".parquet",), needs_all=True),
    "json": TrackFormat(_ALL, write_json_tracks, (".json",), needs_all=True),
}


def read_tracks(path: Path | str, *, recording: Recording | None = None) -> Trajectories:
    """Read tracks of psotrack or of another program, from a file or a folder.

    CSV and Parquet (see `read_trajectories`), JSON, TUM, KITTI, MOT 3D, C3D and MCAP are recognised by ending and
    content. Times decide: tracks get the frame numbers of the recording's instants, if all their times are instants; a
    rate of their own, if all times are multiples of an interval; else they are interpolated at the instants, never
    across a missing sample. A warning says where frame numbers in the file say something else.

    Args:
        path: file or folder.
        recording: the recording that was tracked; None if unknown. Without it, files that have neither times nor a rate
            cannot be read.

    Raises:
        InputError: there is no such file, its format is unknown, or it cannot be read.
        SettingsError: the libraries for MCAP are not installed.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(path, expected="a file or folder of tracks", found="no such file or folder")
    check_kind(path, "tracks")
    read = _read_folder if path.is_dir() else _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(path, expected=_KINDS, found=repr(path.name))
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(path, expected="tracks", found="an empty file")
    with errors_name(path):
        return read(path, recording)


def _read_folder(path: Path, recording: Recording | None) -> Trajectories:
    """Read a folder of TUM, KITTI or MCAP files, or the one that an export to MOT wrote."""
    if (path / WORLD / TRACKS).is_file():
        return read_mot_positions(path / WORLD / TRACKS, recording)
    if any(path.glob("*.mcap")):
        return read_mcap(path, recording)
    if files := sorted(path.glob("*.tum")):
        return joined(path, [read_tum(file) for file in files], recording)
    folder = path / POSES if (path / POSES).is_dir() else path
    files = [file for file in sorted(folder.glob("*.txt")) if not file.stem.endswith("times")]
    counts = {len(number_words(first_line(file))) for file in files}
    if counts == {_TUM}:
        return joined(path, [read_tum(file) for file in files], recording)
    if counts == {_KITTI}:
        return joined(path, [read_kitti(file, recording) for file in files], recording)
    found = "files of boxes alone" if (path / "trackers").is_dir() else "a folder without them"
    raise InputError(path, expected=_KINDS, found=found)


def _read_table(path: Path, recording: Recording | None) -> Trajectories:
    read = read_trajectories(path, fps=None if recording is None else recording.fps)
    return on_clock(path, read, recording)


def _read_csv(path: Path, recording: Recording | None) -> Trajectories:
    """Read a table with names of columns, or lines of numbers without, as in a MOT file."""
    read = _read_text if are_numbers(number_words(first_line(path))) else _read_table
    return read(path, recording)


def _read_text(path: Path, recording: Recording | None) -> Trajectories:
    line = first_line(path)
    count = len(number_words(line))
    if "," in line or count == 10:
        return read_mot_positions(path, recording)
    if count == _TUM:
        return joined(path, [read_tum(path)], recording)
    if count == _KITTI:
        return joined(path, [read_kitti(path, recording)], recording)
    raise InputError(
        path,
        expected="8 numbers per line (TUM), 12 (KITTI), or 10 with commas (MOT)",
        found=repr(line[:80]) if line else "no line with numbers",
    )


#: How a file is read, by its ending.
_READERS: dict[str, Read] = {
    ".csv": _read_csv,
    ".parquet": _read_table,
    ".json": lambda path, recording: on_clock(path, read_json_tracks(path), recording),
    ".tum": lambda path, recording: joined(path, [read_tum(path)], recording),
    ".txt": _read_text,
    ".c3d": read_c3d_tracks,
    ".mcap": read_mcap,
}
_KINDS = (
    f"tracks as {', '.join(_READERS)} (.txt: TUM, KITTI or MOT), or a folder of TUM, KITTI, MOT or MCAP files"
)


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
    if not len(kept) and STATUS not in form.holds:
        raise InputError("tracks", expected="a drone that is seen in some frame", found="none")
    if not form.needs_all:
        trajectories = trajectories.of_drones(kept.tolist())
        if footage is not None and footage.size_m is not None:
            footage = replace(footage, size_m=footage.size_m[kept])
    with atomic_write(out) as temporary:
        lost += form.write(temporary, trajectories, footage, report) or []
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
    file, remedy = f"a file that ends in {' or '.join(form.suffixes)}", ""
    expected = ", or ".join([*(["a folder"] if form.entries else []), *([file] if form.suffixes else [])])
    fits = is_file or (is_folder and bool(form.entries))
    if to == "mot":
        expected, fits = "a folder, for positions and boxes", is_folder
        if footage is None:
            expected, fits = f"{file}, for positions alone", is_file
            remedy = "name SEQ for a folder with boxes per camera"
    elif is_file and form.is_of_one and num_seen > 1:
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

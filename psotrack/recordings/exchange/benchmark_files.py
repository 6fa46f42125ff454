"""Files of benchmarks: KITTI odometry, and MOTChallenge.

KITTI odometry: poses/NAME.txt with the 12 numbers of a pose per line, and sequences/NAME/times.txt with its times.

A line is the first three rows of the 4 x 4 matrix [R | t] that turns body coordinates into world coordinates, row by
row (Geiger et al., CVPR 2012). The format has no gaps and no unknown rotation. Frames in which a drone is not seen have
no line, and the times say which frames the lines are; an unknown orientation is the identity in every line.

MOTChallenge: boxes per camera in the folders that TrackEval reads, and positions in MOT15's 3D columns.

A line is `frame, id, left, top, width, height, confidence, x, y, z` with frames, identities and pixels counted from 1,
and -1 where there is nothing (Leal-Taixe et al. 2015). A reference has `frame, id, left, top, width, height, 1, class,
visibility` (Milan et al. 2016), which serves every benchmark of TrackEval.

    3d/tracks.txt, 3d/reference.txt, 3d/seqinfo.ini       positions in metres; frames are the recording's instants
    gt/MOT15-train/SEQ-CAMERA/gt/gt.txt, seqinfo.ini      boxes of the reference
    gt/seqmaps/MOT15-train.txt                            names of the sequences
    trackers/MOT15-train/psotrack/data/SEQ-CAMERA.txt     boxes of the tracks
"""

from __future__ import annotations

import configparser
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError
from psotrack.recordings import Recording
from psotrack.recordings.exchange.camera_boxes import Footage, boxes_in_camera, camera_frames
from psotrack.recordings.exchange.timed_paths import interval_s
from psotrack.support import Report, check_file_name, first_repeat, first_true, read_numbers, write_rows
from psotrack.trajectories import UNASSIGNED, DroneRows, Trajectories, from_rows, timed_path
from psotrack.trajectories.association import align, fixed_identity

_Rows = Float[np.ndarray, "rows"]
POSES, SEQUENCES, TIMES = "poses", "sequences", "times.txt"
#: Largest difference of R R' from the identity: KITTI's own files have 7 digits.
_ROTATION = 1e-4


def write_kitti(folder: Path, trajectories: Trajectories, footage: Footage | None, report: Report) -> None:
    """Write the poses and times of each drone into a new folder.

    Raises:
        InputError: a drone's name cannot be the name of a file.
    """
    for drone, name in enumerate(trajectories.drones):
        check_file_name(name, "drones")
        seen = trajectories.seen[:, drone]
        poses = np.zeros((int(seen.sum()), 3, 4))
        poses[:, :, :3] = _rotations(trajectories, drone)
        poses[:, :, 3] = trajectories.position_m[seen, drone]
        write_rows(folder / POSES / f"{name}.txt", poses.reshape(-1, 12).tolist(), " ")
        write_rows(folder / SEQUENCES / name / TIMES, trajectories.time_s[seen, None].tolist())


def find_times(file: Path) -> Path | None:
    """The file with the times of a file of poses: KITTI's own place, NAME_times.txt beside the file, or times.txt."""
    candidates = (
        file.parent.parent / SEQUENCES / file.stem / TIMES,
        file.with_name(f"{file.stem}_{TIMES}"),
        file.with_name(TIMES),
    )
    return next((path for path in candidates if path.is_file()), None)


def read_kitti(file: Path, recording: Recording | None) -> Trajectories:
    """The path in a file of poses. Without a file of times, line k is instant k of the recording.

    Args:
        file: file of poses; the drone has its name.
        recording: the recording, or None if none is known.

    Raises:
        InputError: a file cannot be read, a line is no pose, or poses and times differ in number; there are no times
            and no recording, or a recording of another length.
    """
    read = read_numbers(file, 12, "12 finite numbers: the rows of [R | t]")
    poses = read.values.reshape(-1, 3, 4)
    R = poses[:, :, :3]
    off = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    if (row := first_true((off > _ROTATION) | (np.linalg.det(R) < 0))) is not None:
        raise read.error(row, expected="a rotation matrix", found="another matrix")
    orientation = Rotation.from_matrix(R).as_quat(scalar_first=True, canonical=True)
    return timed_path(file.stem, _times(file, len(poses), recording), poses[:, :, 3], orientation)


def _times(file: Path, count: int, recording: Recording | None) -> _Rows:
    beside = find_times(file)
    if beside is not None:
        read = read_numbers(beside, 1, "one time in seconds per line")
        time_s = read.values[:, 0]
        if len(time_s) != count:
            raise InputError(
                beside, expected=f"{count} times, as many as {file.name} has poses", found=f"{len(time_s)}"
            )
        if (row := first_repeat(time_s)) is not None:
            raise read.error(
                row, expected="times that increase from line to line", found=f"{time_s[row]:g} s"
            )
        return time_s
    if recording is None:
        raise InputError(
            file,
            expected=f"a file of times, {SEQUENCES}/{file.stem}/{TIMES}",
            found="none",
            remedy="name SEQ, too",
        )
    instant_s = recording.timeline().time_s
    if len(instant_s) != count:
        raise InputError(
            file,
            expected=f"{len(instant_s)} poses, one for each instant of the recording, or a file of times",
            found=f"{count} poses",
        )
    return instant_s


def _rotations(trajectories: Trajectories, drone: int) -> Float[np.ndarray, "rows 3 3"]:
    """Rotations of a drone where it is seen; the identity everywhere if one of these frames has no orientation."""
    seen = trajectories.seen[:, drone]
    orientation = trajectories.orientation_wxyz
    if orientation is None or not np.isfinite(orientation[seen, drone]).all():
        return np.broadcast_to(np.eye(3), (int(seen.sum()), 3, 3))
    return Rotation.from_quat(orientation[seen, drone].astype(float), scalar_first=True).as_matrix()


#: The folder of TrackEval: with the benchmark MOT15, TrackEval leaves nothing out.
BENCHMARK, SPLIT, TRACKER = "MOT15", "train", "psotrack"
WORLD, TRACKS, REFERENCE, INFO = "3d", "tracks.txt", "reference.txt", "seqinfo.ini"
#: Largest number of a frame or an identity.
_LARGEST = 2**31
#: A lower rate is none; times would overflow.
_SLOWEST_HZ = 1e-6
_COLUMNS = "frame, id, left, top, width, height, confidence, x, y, z"


def write_mot(path: Path, trajectories: Trajectories, footage: Footage | None, report: Report) -> list[str]:
    """Write a file of positions, or with a recording a new folder with boxes, too; return what is missing in it.

    Raises:
        SettingsError: the sizes of the drones are not known, for boxes.
    """
    if footage is not None:
        return _write_folder(path, trajectories, footage, report)
    write_mot_positions(path, trajectories)
    return ["boxes, which need SEQ", "the rate"]


def write_mot_positions(path: Path, trajectories: Trajectories) -> None:
    """Write positions in MOT15's 3D columns; drones have the numbers 1, 2, ... in their order."""
    rows = (
        (trajectories.frame[row] + 1, drone + 1, -1, -1, -1, -1, 1, *trajectories.position_m[row, drone])
        for row, drone in np.argwhere(trajectories.seen)
    )
    write_rows(path, rows, ",")


def _write_folder(folder: Path, trajectories: Trajectories, footage: Footage, report: Report) -> list[str]:
    """Write positions, and boxes per camera.

    Boxes are those of the drones' ellipsoids, as in `geometry.boxes`, at the time at which the camera exposed the
    frame. Boxes of the reference have the sizes of the tracks that belong to its drones.
    """
    recording, size_m = footage.recording, footage.size_m
    if size_m is None:
        raise SettingsError(
            "--drone-size",
            expected="the drones' size, for boxes in the cameras",
            found="none, and no record beside the tracks that has it",
            remedy="name it, or leave out SEQ to write positions alone",
        )
    truth = _reference(recording, trajectories)
    write_mot_positions(folder / WORLD / TRACKS, trajectories)
    if truth is not None:
        write_mot_positions(folder / WORLD / REFERENCE, truth)
    fps = 1 / interval_s(trajectories)
    _write_info(folder / WORLD, recording.name, fps, int(trajectories.frame[-1]) + 1, None)
    cameras = camera_frames(recording, trajectories)
    split = f"{BENCHMARK}-{SPLIT}"
    names = []
    with report("boxes", len(cameras)) as advance:
        for camera, times in cameras.items():
            name = check_file_name(f"{recording.name}-{camera}", recording.folder)
            names.append(name)
            sequence = folder / "gt" / split / name
            size_wh = recording.rig.cameras.image_size_wh[recording.rig.names.index(camera)].astype(int)
            _write_info(sequence, name, times.fps, times.num_frames, size_wh.tolist())
            boxes = boxes_in_camera(recording, camera, times, trajectories, size_m)
            _write_boxes(folder / "trackers" / split / TRACKER / "data" / f"{name}.txt", boxes, (-1, -1, -1))
            if truth is not None:
                truth_m = _reference_sizes(trajectories, truth, size_m)
                boxes = boxes_in_camera(recording, camera, times, truth, truth_m)
                _write_boxes(sequence / "gt" / "gt.txt", boxes, (1, 1))
            advance(1)
    write_rows(folder / "gt" / "seqmaps" / f"{split}.txt", [[name] for name in ("name", *names)])
    return [] if truth is not None else ["boxes of a reference, because SEQ has none"]


def read_mot_positions(path: Path, recording: Recording | None) -> Trajectories:
    """Positions from MOT15's 3D columns; drones have their numbers as names.

    Args:
        path: the file; its frame 1 is the recording's first instant. `seqinfo.ini` beside the file says its rate.
        recording: the recording, or None.

    Raises:
        InputError: the file cannot be read, has boxes only, has a drone twice in a frame, or there is no rate.
    """
    read = read_numbers(path, 10, f"positions in MOT15's 3D columns: {_COLUMNS}", more=True)
    number = read.values[:, :2]
    wrong = (number[:, 0] < 1) | ((number != np.floor(number)) | (np.abs(number) > _LARGEST)).any(axis=1)
    if (row := first_true(wrong)) is not None:
        raise read.error(row, expected="whole frame numbers from 1", found=f"{number[row, 0]:g}")
    if (read.values[:, 7:] == -1).all():
        found = "boxes alone: x, y and z are -1 in every row"
        remedy = "name a file with 3D columns, or the folder that `psotrack export --to mot` wrote"
        raise InputError(path, expected="positions in MOT15's 3D columns", found=found, remedy=remedy)
    # Drones have the order of their first rows: here that of their numbers.
    order = np.argsort(number[:, 1], kind="stable")
    frame, identity = number[order, 0] - 1, number[order, 1].astype(int)
    columns = {
        "frame": frame,
        "time_s": _times_of_rows(path, frame, recording),
        "drone": identity.astype(str).astype(object),
        **dict(zip(("x_m", "y_m", "z_m"), read.values[order, 7:].T, strict=True)),
    }
    return from_rows(path, DroneRows(columns, lambda row: f"{path}, line {read.lines[order[row]]}"))


def _times_of_rows(path: Path, frame: _Rows, recording: Recording | None) -> _Rows:
    """(rows,), times of the rows' frames, seconds."""
    info = path.with_name(INFO)
    fps = None
    if info.is_file():
        parser = configparser.ConfigParser()
        try:
            parser.read(info, encoding="utf-8")
            fps = float(parser["Sequence"]["frameRate"])
        except (configparser.Error, KeyError, ValueError) as error:
            raise InputError(info, expected="a frameRate", found=f"{error}".partition("\n")[0]) from error
        if not _SLOWEST_HZ < fps < np.inf:
            raise InputError(info, expected=f"a frameRate above {_SLOWEST_HZ:g}", found=f"{fps:g}")
    if recording is not None and (fps is None or abs(fps / recording.fps - 1) < 1e-3):
        time_s = recording.timeline().time_s
        instant = np.minimum(frame, len(time_s) - 1).astype(int)
        return np.where(frame < len(time_s), time_s[instant], frame / recording.fps)
    if fps is None:
        raise InputError(
            path, expected=f"a rate, in {INFO} beside the file", found="none", remedy="name SEQ, too"
        )
    return frame / fps


def _reference(recording: Recording, trajectories: Trajectories) -> Trajectories | None:
    """The reference until the end of the tracks; None without a known position."""
    truth = recording.truth
    if truth is None or not truth.seen.any():
        return None
    return truth.at_frames(truth.frame[truth.time_s <= trajectories.time_s[-1] + 1e-9])


def _reference_sizes(
    trajectories: Trajectories, truth: Trajectories, size_m: Float[np.ndarray, "drones 3"]
) -> Float[np.ndarray, "references 3"]:
    """(references, 3), sizes of the tracks that belong to the reference's drones, and else the tracks' median size."""
    sizes = np.repeat(np.median(size_m, axis=0)[None], truth.num_drones, axis=0)
    try:
        pair = align(trajectories, truth)
    except InputError:  # no frame in common, because the tracks have a rate of their own
        return sizes
    for name, partner in zip(pair.drones, fixed_identity(pair), strict=True):
        if partner != UNASSIGNED:
            sizes[truth.drones.index(name)] = size_m[partner]
    return sizes


def _write_boxes(path: Path, xyxy: Float[np.ndarray, "frames drones 4"], end: tuple[int, ...]) -> None:
    """Write boxes with a thousandth of a pixel; the left column of the image is 1."""
    rows = []
    for frame, drone in np.argwhere(np.isfinite(xyxy).all(axis=-1)):
        x0, y0, x1, y1 = xyxy[frame, drone]
        box = (f"{number:.3f}" for number in (x0 + 1, y0 + 1, x1 - x0, y1 - y0))
        rows.append((frame + 1, drone + 1, *box, 1, *end))
    write_rows(path, rows, ",")


def _write_info(folder: Path, name: str, fps: float, frames: int, size_wh: list[int] | None) -> None:
    values = {"name": name, "imDir": "img1", "frameRate": float(fps), "seqLength": frames}
    if size_wh is not None:
        values |= {"imWidth": size_wh[0], "imHeight": size_wh[1], "imExt": ".jpg"}
    write_rows(folder / INFO, [["[Sequence]"], *values.items()], "=")

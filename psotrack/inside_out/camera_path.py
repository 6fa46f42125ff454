"""`CameraPath`: position and orientation of a moving camera in every frame, and its table on disk.

The table has one row per frame. Its columns include all columns that `psotrack.trajectories.files` reads, so that every
command that reads tracks reads the table too.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError, errors_name
from psotrack.geometry import rotation_matrices
from psotrack.support import (
    Table,
    TextRow,
    atomic_write,
    has_negative_eigenvalue,
    read_table,
    refuse_to_overwrite,
    short_repr,
)
from psotrack.trajectories import Status, Trajectories, read_trajectories, roll_pitch_yaw_deg

#: Axes of the covariance: the world's axes, in metres, then small turns about the camera's axes, in radians.
_AXES = "xyzabc"
_UPPER = np.triu_indices(6)
_QUATERNION = ("qw", "qx", "qy", "qz")
_ROTATION = tuple(f"r{row}{column}" for row, column in itertools.product("123", repeat=2))
_ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
_COVARIANCE = tuple(f"cov_{_AXES[row]}{_AXES[column]}" for row, column in zip(*_UPPER, strict=True))


class Flag(IntFlag):
    """Remarks on a frame, in addition to its status."""

    #: The frame has 1 or more markers, but fewer than 4 (the paper's number) or fewer than required.
    FEW_MARKERS = 1
    #: Another pose fits about equally well, and neither markers nor motion decide between the two.
    AMBIGUOUS = 2
    #: The frame's own pose did not fit the motion and was not used.
    GATED = 4

    @property
    def label(self) -> str:
        """The names of the flags as in tables, with + between them."""
        return "+".join(flag.name.lower() for flag in Flag if flag in self and flag.name)


@dataclass(frozen=True, repr=False)
class CameraPath:
    """Poses of a camera over frames. Values that are not known are NaN.

    Attributes:
        frame: (frames,), numbers of the video frames, 0-based, increasing.
        time_s: (frames,), seconds, increasing.
        position_m: (frames, 3), the camera's centre, world, metres.
        orientation_wxyz: (frames, 4), unit quaternions, camera to world; camera axes x right, y down, z ahead.
        covariance: (frames, 6, 6), of the position along the world's axes (m) and of a small turn about the
            camera's axes (rad): the true orientation is R exp([turn]), with R the estimated one.
        num_markers: (frames,), number of markers behind the pose; without a pose, number of detected markers.
        reprojection_px: (frames,), root mean square distance between the markers' corners and their projections,
            pixels.
        ambiguity: (frames,), probability that another pose is the right one, 0 to 1/2.
        status: (frames,), values of `Status`: `TRACKED` where the frame's own markers were used, `COASTING` where the
            pose is from the motion, `LOST` where there is no pose.
        flags: (frames,), values of `Flag`.
        velocity_m_s: (frames, 3), world; None without a filter.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: Float[np.ndarray, "frames"]
    position_m: Float[np.ndarray, "frames 3"]
    orientation_wxyz: Float[np.ndarray, "frames 4"]
    covariance: Float[np.ndarray, "frames 6 6"]
    num_markers: Int[np.ndarray, "frames"]
    reprojection_px: Float[np.ndarray, "frames"]
    ambiguity: Float[np.ndarray, "frames"]
    status: Int[np.ndarray, "frames"]
    flags: Int[np.ndarray, "frames"]
    velocity_m_s: Float[np.ndarray, "frames 3"] | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for name, shape in {"position_m": (3,), "orientation_wxyz": (4,), "covariance": (6, 6)}.items():
            found = getattr(self, name).shape
            if found != (len(self.frame), *shape):
                expected = f"shape {(len(self.frame), *shape)}"
                raise InputError(f"camera_path.{name}", expected=expected, found=f"{found}")
        if not ((np.diff(self.frame) > 0).all() and (np.diff(self.time_s) > 0).all()):
            found = "repeats, steps back or no numbers"
            raise InputError("camera_path.frame", expected="increasing frames and times", found=found)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.frame)

    @property
    def seen(self) -> Bool[np.ndarray, "frames"]:
        """(frames,), whether a frame has a pose and is not lost."""
        return np.isfinite(self.position_m).all(axis=-1) & (self.status != Status.LOST)

    def trajectories(self, name: str) -> Trajectories:
        """The path as the trajectory of one drone with this name; its orientation is the camera's."""
        return Trajectories(
            frame=self.frame,
            time_s=self.time_s,
            drones=(name,),
            position_m=self.position_m[:, None],
            velocity_m_s=None if self.velocity_m_s is None else self.velocity_m_s[:, None],
            orientation_wxyz=self.orientation_wxyz[:, None],
            status=self.status[:, None],
            covariance_m2=self.covariance[:, None, :3, :3],
        )


def write_camera_path(path: Path | str, camera_path: CameraPath, name: str, *, force: bool = False) -> None:
    """Write a CSV with one row per frame; values that are not known are empty fields.

    Columns: `frame`, `time_s`, `drone`, `x_m` to `z_m`, `vx_m_s` to `vz_m_s`, `qw` to `qz` and `r11` to `r33` (both
    camera to world), `roll_deg`, `pitch_deg`, `yaw_deg` (see `roll_pitch_yaw_deg`), `cov_xx` to `cov_cc` (the upper
    triangle; a, b and c are small turns about the camera's x, y and z axes), `num_markers`, `reprojection_px`,
    `ambiguity`, `flags` (words with + between them), `status`.

    Args:
        path: file to write.
        camera_path: path to write.
        name: name of the drone that carries the camera.
        force: replace an existing file.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    path = Path(path)
    refuse_to_overwrite(path, force)
    tracks = camera_path.trajectories(name).to_pandas()
    wxyz = camera_path.orientation_wxyz
    others = {
        **_split(_ROTATION, rotation_matrices(wxyz).reshape(-1, 9)),
        **_split(_ANGLES, roll_pitch_yaw_deg(wxyz)),
        **_split(_COVARIANCE, camera_path.covariance[:, *_UPPER]),
        "num_markers": camera_path.num_markers,
        "reprojection_px": camera_path.reprojection_px,
        "ambiguity": camera_path.ambiguity,
        "flags": [Flag(int(flags)).label for flags in camera_path.flags],
    }
    places = tracks.columns[:9]
    with atomic_write(path) as temporary:
        table = tracks.assign(**others)[[*places, *_QUATERNION, *others, "status"]]
        table.to_csv(temporary, index=False)


def read_camera_path(path: Path | str) -> tuple[CameraPath, str]:
    """Read a table that `write_camera_path` wrote.

    Returns:
        The path, and the drone's name.

    Raises:
        InputError: the file cannot be read, a column is missing, or a value is invalid; the message names the line.
    """
    path = Path(path)
    table = read_table(path, ",")
    if table.find("qw") is None:
        raise InputError(
            path,
            expected="a camera's path with orientations, qw to qz",
            found="none",
            remedy="localise writes one",
        )
    tracks = read_trajectories(path)
    if tracks.num_drones > 1:
        expected, found = "the path of one drone", ", ".join(sorted(tracks.drones))
        raise InputError(path, expected=expected, found=found)
    # Tracks have the order of frames.
    rows = sorted(table.rows, key=lambda row: row.count(table.column("frame")))
    covariance = np.zeros((len(rows), 6, 6))
    covariance[:, *_UPPER] = _numbers(table, rows, *_COVARIANCE)
    covariance += np.triu(covariance, 1).swapaxes(-1, -2)
    for row in np.flatnonzero(has_negative_eigenvalue(covariance)):
        expected, found = "a covariance in cov_xx to cov_cc", "a matrix with a negative eigenvalue"
        raise rows[row].error(table.column("cov_xx"), expected, found)
    unknown = np.full((len(rows), 4), np.nan)
    with errors_name(path):
        camera_path = CameraPath(
            frame=tracks.frame,
            time_s=tracks.time_s,
            position_m=tracks.position_m[:, 0],
            orientation_wxyz=unknown if tracks.orientation_wxyz is None else tracks.orientation_wxyz[:, 0],
            covariance=covariance,
            num_markers=np.array([row.count(table.column("num_markers")) for row in rows]),
            reprojection_px=_numbers(table, rows, "reprojection_px")[:, 0],
            ambiguity=_numbers(table, rows, "ambiguity")[:, 0],
            status=np.zeros(len(rows), int) if tracks.status is None else tracks.status[:, 0],
            flags=np.array([_flags(row, table) for row in rows]),
            velocity_m_s=None if tracks.velocity_m_s is None else tracks.velocity_m_s[:, 0],
        )
    return camera_path, tracks.drones[0]


def _split(names: tuple[str, ...], values: Float[np.ndarray, "frames columns"]) -> Mapping:
    return dict(zip(names, values.T, strict=True))


def _numbers(table: Table, rows: Sequence[TextRow], *names: str) -> Float[np.ndarray, "rows columns"]:
    """(rows, columns), NaN for empty cells."""
    columns = [table.column(name) for name in names]
    return np.array(
        [[row.number(each) if row.cells[each.index] else np.nan for each in columns] for row in rows]
    )


def _flags(row: TextRow, table: Table) -> int:
    column = table.column("flags")
    words = row.cells[column.index].split("+") if row.cells[column.index] else []
    known = {flag.label: flag for flag in Flag}
    for word in words:
        if word not in known:
            raise row.error(column, f"words of {', '.join(known)} with + between them", repr(word))
    return int(sum(known[word] for word in words))

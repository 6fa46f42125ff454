"""Tracks as JSON that explains itself: version, units, frames, and all quantities of each drone, null where unknown."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from psotrack.errors import InputError, PsotrackError
from psotrack.recordings.exchange.camera_boxes import Footage
from psotrack.support import Report, read_json
from psotrack.trajectories import QUANTITIES, Status, Trajectories, check_cells
from psotrack.trajectories.columns import ALL_COLUMNS, PARTS

#: Value of the key `format`, and version of the keys' meaning.
NAME, VERSION = "psotrack tracks", 1
_TURN = "unit quaternion, body to world"
_STATUS = {status.label: int(status) for status in Status}


def write_json_tracks(
    path: Path, trajectories: Trajectories, footage: Footage | None, report: Report
) -> None:
    """Write all quantities of trajectories; numbers have all digits."""
    known = trajectories.quantities()
    content = {
        "format": NAME,
        "version": VERSION,
        "axes": "world of the calibration, z up",
        "units": {"frame": "1", "time_s": "s"} | {name: _unit(name) for name in known},
        "frame": trajectories.frame.tolist(),
        "time_s": trajectories.time_s.tolist(),
        "drones": [
            {"name": name} | {key: _plain(key, value[:, drone]) for key, value in known.items()}
            for drone, name in enumerate(trajectories.drones)
        ],
    }
    path.write_text(json.dumps(content, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def read_json_tracks(path: Path) -> Trajectories:
    """Read trajectories from JSON.

    Raises:
        InputError: the file is not JSON of this format and version, or a quantity does not have a value per frame.
    """
    content = read_json(path, "JSON with tracks")
    if content.get("format") != NAME:
        remedy = "the record of a run has no positions: name its .csv or .parquet"
        raise InputError(path, expected=f'tracks, with "format": "{NAME}"', found="other JSON", remedy=remedy)
    if content.get("version") != VERSION:
        raise InputError(path, expected=f"version {VERSION}", found=f"{content.get('version')}")
    try:
        frame = np.array(content["frame"], np.int64)
        drones = content["drones"]
        rows = sum(len(drone["position_m"]) for drone in drones)
        check_cells(path, len(frame), len(drones), rows)
        values: dict[str, Any] = {name: _stacked(name, drones, len(frame)) for name in QUANTITIES}
        return Trajectories(
            frame=frame,
            time_s=np.array(content["time_s"], float),
            drones=tuple(str(drone["name"]) for drone in drones),
            **values,
        )
    except PsotrackError as error:
        raise InputError(path, expected="consistent tracks", found=f"{error}") from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        found = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise InputError(
            path, expected="frame, time_s and drones with a value per frame", found=found
        ) from error


def _unit(name: str) -> str:
    """Unit of a quantity of a drone."""
    return _TURN if name == "orientation_wxyz" else ALL_COLUMNS[PARTS[name][0]]


def _plain(name: str, values: np.ndarray) -> list[Any]:
    """One value per frame: a number, lists of numbers, or a word; None where any of its numbers is NaN."""
    if name == "status":
        return [Status(value).label for value in values.tolist()]
    known = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    return [value if is_known else None for value, is_known in zip(values.tolist(), known, strict=True)]


def _stacked(name: str, drones: list[dict[str, Any]], frames: int) -> np.ndarray | None:
    """(frames, drones, ...), values of all drones; None if no drone has the quantity."""
    if not any(name in drone for drone in drones):
        if name == "position_m":
            raise KeyError(name)
        return None
    whole = name in ("status", "num_cameras")
    unknown = np.full(QUANTITIES[name], -1 if whole else np.nan).tolist()
    stacked = np.empty((frames, len(drones), *QUANTITIES[name]), np.int64 if whole else float)
    for index, drone in enumerate(drones):
        values = drone[name]
        if len(values) != frames:
            raise ValueError(f"{len(values)} values of {name} for {frames} frames")
        if name == "status":
            values = [_STATUS[value or Status.LOST.label] for value in values]
        stacked[:, index] = [unknown if value is None else value for value in values]
    if np.isinf(stacked).any():
        raise ValueError(f"an infinite number in {name}")
    return stacked

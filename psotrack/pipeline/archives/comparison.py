"""Comparison of an archive's tracks with those that were computed again from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from psotrack.errors import InputError
from psotrack.pipeline.archives.manifest import Manifest
from psotrack.settings import TrackSettings, flatten
from psotrack.support import read_text
from psotrack.trajectories import Trajectories, read_trajectories

#: Parts of a record that say by what a result was computed.
_ENVIRONMENT = ("versions", "device")
#: Arrays of trajectories that are compared.
_ARRAYS = (
    "frame", "time_s", "position_m", "velocity_m_s", "fitness", "num_cameras", "status", "covariance_m2",
    "relative_covariance_m2",
)  # fmt: skip


@dataclass(frozen=True)
class ArchiveComparison:
    """What differs between the tracks of an archive and those that were computed again.

    Attributes:
        same: whether the tracks are the same, number by number.
        from_frame: first frame in which the tracks differ; None where they are the same, or differ in their frames or
            drones.
        from_s: time of this frame, seconds.
        max_distance_m: largest distance between both positions of a drone; None where no positions can be compared.
        unlike: what cannot be compared, in words: "frames" or "drones"; empty where both are alike.
        differences: values of the archive and of now by name, of settings, cameras, inputs, versions and device.
    """

    same: bool
    from_frame: int | None
    from_s: float | None
    max_distance_m: float | None
    unlike: str
    differences: Mapping[str, tuple[Any, Any]]

    def to_dict(self) -> dict[str, Any]:
        """The comparison, fit for JSON."""
        return {
            "same": self.same,
            "from_frame": self.from_frame,
            "from_s": self.from_s,
            "max_distance_m": self.max_distance_m,
            "unlike": self.unlike or None,
            "differences": {
                name: {"archive": was, "now": now} for name, (was, now) in self.differences.items()
            },
        }

    def sentence(self, archive: str) -> str:
        """The comparison in one line.

        Args:
            archive: name of the archive.
        """
        listed = ", ".join(
            f"{name} {_word(was)} -> {_word(now)}" for name, (was, now) in self.differences.items()
        )
        if self.same:
            return f"the same tracks as in {archive}" + (
                f", although there differ: {listed}" if listed else ""
            )
        if self.unlike:
            how = f"other {self.unlike} than"
        else:
            distance = (
                "" if self.max_distance_m is None else f", by at most {1e3 * self.max_distance_m:.3g} mm"
            )
            how = f"other tracks from frame {self.from_frame} ({self.from_s:.3f} s) on{distance}, than"
        reason = listed or "nothing that is recorded: another processor, or other settings of XLA or of JAX?"
        return f"{how} in {archive}; there differ: {reason}"


def compare_with_archive(
    folder: Path, manifest: Manifest, tracks: Path, record: Mapping[str, Any], settings: TrackSettings
) -> ArchiveComparison:
    """Compare tracks that were computed again with those of an archive.

    Args:
        folder: folder of the unpacked archive.
        manifest: its manifest.
        tracks: file of the tracks that were computed again.
        record: their record.
        settings: the settings that were asked for, with paths that lead into the archive.

    Raises:
        InputError: a file of the archive cannot be read.
    """
    was = folder / manifest.tracks
    exact = was.suffix == tracks.suffix
    old, new = read_trajectories(was), read_trajectories(tracks)
    old_record = _read_record(folder / manifest.record)
    differences = _differences(
        {**dict(flatten(manifest.settings)), **_circumstances(old_record)},
        # By way of JSON, which has lists and no tuples.
        {**dict(flatten(msgspec.json.decode(msgspec.json.encode(settings)))), **_circumstances(record)},
    )
    unlike = ""
    if not np.array_equal(old.frame, new.frame):
        unlike = "frames"
    elif old.drones != new.drones:
        unlike = "drones"
    if unlike:
        return ArchiveComparison(False, None, None, None, unlike, differences)
    differs = np.zeros(old.num_frames, bool)
    for name in _ARRAYS:
        differs |= _differing_frames(getattr(old, name), getattr(new, name), exact)
    if not differs.any():
        return ArchiveComparison(True, None, None, 0.0, "", differences)
    first = int(differs.argmax())
    return ArchiveComparison(
        same=False,
        from_frame=int(old.frame[first]),
        from_s=float(old.time_s[first]),
        max_distance_m=_largest_distance_m(old, new),
        unlike="",
        differences=differences,
    )


def _differing_frames(old: np.ndarray | None, new: np.ndarray | None, exact: bool) -> np.ndarray:
    """(frames,), whether the values of a frame differ; where one of both is unknown, all frames."""
    if old is None or new is None:
        known = old if old is not None else new
        return np.zeros(1, bool) if known is None else np.ones(len(known), bool)
    if not exact and old.dtype.kind == "f":
        # CSV has the digits of the tracker's float32, Parquet has float64.
        old, new = old.astype(np.float32), new.astype(np.float32)
    unequal = (old != new) & ~((old != old) & (new != new))
    return unequal.reshape(len(old), -1).any(axis=1)


def _largest_distance_m(old: Trajectories, new: Trajectories) -> float | None:
    distance_m = np.linalg.norm(old.position_m - new.position_m, axis=-1)
    known = np.isfinite(distance_m)
    return float(distance_m[known].max()) if known.any() else None


def _circumstances(record: Mapping[str, Any]) -> dict[str, Any]:
    """What a record says of the run besides the settings."""
    found = {
        "cameras": record.get("cameras"),
        "frames": record.get("frames"),
        "causal": record.get("causal", False),
        **dict(flatten(record.get("parts", {}), "parts.")),
        **dict(flatten(record.get("input_keys", {}), "input_keys.")),
    }
    for part in _ENVIRONMENT:
        found |= record.get(part, {})
    return found


def _differences(was: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    names = [*was, *(name for name in now if name not in was)]
    return {name: (was.get(name), now.get(name)) for name in names if was.get(name) != now.get(name)}


def _word(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_word, value))
    return "none" if value is None else f"{value}"


def _read_record(path: Path) -> dict[str, Any]:
    try:
        return msgspec.json.decode(read_text(path), type=dict[str, Any])
    except msgspec.DecodeError as error:
        raise InputError(path, expected="the record of the tracks", found=f"{error}") from error

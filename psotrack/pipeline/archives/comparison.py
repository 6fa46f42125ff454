"""Comparison of an archive's tracks with those that were computed again from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from psotrack.pipeline.archives.archive_file import Manifest, TrackRecord, read_record
from psotrack.settings import TrackSettings, flatten
from psotrack.trajectories import read_trajectories

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
        unlike: what cannot be compared, in words: "frames" or "drones"; None where both are alike.
        differences: values of the archive and of now by name, of settings, cameras, inputs, versions and device.
    """

    same: bool
    differences: Mapping[str, tuple[Any, Any]]
    from_frame: int | None = None
    from_s: float | None = None
    max_distance_m: float | None = None
    unlike: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """The comparison, fit for JSON."""
        differences = {name: {"archive": was, "now": now} for name, (was, now) in self.differences.items()}
        return {**vars(self), "differences": differences}

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
        how = f"other {self.unlike}"
        if self.unlike is None:
            apart_m = self.max_distance_m
            apart = "" if apart_m is None else f", by at most {1e3 * apart_m:.3g} mm"
            how = f"other tracks from frame {self.from_frame} ({self.from_s:.3f} s) on{apart},"
        reason = listed or "nothing that is recorded: another processor, or other settings of XLA or of JAX?"
        return f"{how} than in {archive}; there differ: {reason}"


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
    old, new = read_trajectories(was), read_trajectories(tracks)
    before = _circumstances(manifest.settings, read_record(was))
    now = _circumstances(msgspec.to_builtins(settings), msgspec.convert(record, TrackRecord))
    differences = {
        name: (before.get(name), now.get(name))
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    }
    if not np.array_equal(old.frame, new.frame):
        return ArchiveComparison(False, differences, unlike="frames")
    if old.drones != new.drones:
        return ArchiveComparison(False, differences, unlike="drones")
    exact = was.suffix == tracks.suffix
    differs = np.zeros(old.num_frames, bool)
    for name in _ARRAYS:
        differs |= _differing_frames(getattr(old, name), getattr(new, name), exact)
    if not differs.any():
        return ArchiveComparison(True, differences, max_distance_m=0.0)
    first = int(differs.argmax())
    distance_m = np.linalg.norm(old.position_m - new.position_m, axis=-1)
    known = np.isfinite(distance_m)
    return ArchiveComparison(
        False,
        differences,
        from_frame=int(old.frame[first]),
        from_s=float(old.time_s[first]),
        max_distance_m=float(distance_m[known].max()) if known.any() else None,
    )


def _differing_frames(old: np.ndarray | None, new: np.ndarray | None, exact: bool) -> np.ndarray:
    """(frames,), whether the values of a frame differ; where one of both is unknown, all frames."""
    if old is None or new is None:
        return np.array([old is not new])
    if not exact and old.dtype.kind == "f":
        # CSV has the digits of the tracker's float32, Parquet has float64.
        old, new = old.astype(np.float32), new.astype(np.float32)
    unequal = (old != new) & ~((old != old) & (new != new))
    return unequal.reshape(len(old), -1).any(axis=1)


def _circumstances(settings: Mapping[str, Any], record: TrackRecord) -> dict[str, Any]:
    """Settings that were asked for, and what the record says of the run besides: all on which the tracks depend."""
    of_run = {name: getattr(record, name) for name in ("cameras", "frames", "causal")}
    parts = {name: getattr(record, name) for name in ("parts", "input_keys")}
    # By way of JSON, which has lists and no tuples.
    plain = msgspec.json.decode(msgspec.json.encode({**settings, **of_run, **parts}))
    return {**dict(flatten(plain)), **record.versions, **record.device}


def _word(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_word, value))
    return "none" if value is None else f"{value}"

"""The table of fused tracks on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psotrack.inside_out.fusing.fused import FusedTracks
from psotrack.support import atomic_write, refuse_to_overwrite

#: Words for the values of `FusedTracks.source`.
SOURCES = ("none", "inside", "outside", "both")


def write_fused(path: Path | str, fused: FusedTracks, *, force: bool = False) -> None:
    """Write a CSV with one row per frame and drone; values that are not known are empty fields.

    Columns: `frame`, `time_s`, `drone`, `x_m` to `z_m`, `vx_m_s` to `vz_m_s`, `qw` to `qz` (camera to world), `cov_xx`
    to `cov_zz` (the upper triangle), `source` (both, inside, outside or none), `status`. Every command that reads
    tracks reads the table.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    path = Path(path)
    refuse_to_overwrite(path, force)
    table = fused.trajectories.to_pandas()
    table["source"] = np.array(SOURCES)[fused.source].ravel()
    before = [
        "frame",
        "time_s",
        "drone",
        "x_m",
        "y_m",
        "z_m",
        "vx_m_s",
        "vy_m_s",
        "vz_m_s",
        "qw",
        "qx",
        "qy",
        "qz",
    ]
    covariances = [name for name in table.columns if str(name).startswith("cov_")]
    with atomic_write(path) as temporary:
        table[[*before, *covariances, "source", "status"]].to_csv(temporary, index=False)

"""The table of fused tracks on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from psotrack.inside_out.fusing.fused import FusedTracks
from psotrack.support import refuse_to_overwrite, write_rows
from psotrack.trajectories import Status

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
    tracks = fused.trajectories
    shape = (tracks.num_frames, tracks.num_drones)
    covariance_m2 = None if tracks.covariance_m2 is None else tracks.covariance_m2[..., *np.triu_indices(3)]
    labels = np.array([status.label for status in Status])
    columns: dict[str, Shaped[np.ndarray, "frames drones"]] = {
        "frame": np.broadcast_to(tracks.frame[:, None], shape),
        "time_s": np.broadcast_to(tracks.time_s[:, None], shape),
        "drone": np.broadcast_to(np.array(tracks.drones, str), shape),
        **_split(("x_m", "y_m", "z_m"), tracks.position_m),
        **_split(("vx_m_s", "vy_m_s", "vz_m_s"), tracks.velocity_m_s),
        **_split(("qw", "qx", "qy", "qz"), tracks.orientation_wxyz),
        **_split(("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"), covariance_m2),
        "source": np.array(SOURCES)[fused.source],
        "status": labels[tracks.status],
    }
    rows = zip(*(column.ravel().tolist() for column in columns.values()), strict=True)
    cells = [["" if value != value else value for value in row] for row in rows]
    write_rows(path, [list(columns), *cells], separator=",")


def _split(
    names: tuple[str, ...], values: Float[np.ndarray, "frames drones columns"] | None
) -> dict[str, Float[np.ndarray, "frames drones"]]:
    return {} if values is None else dict(zip(names, np.moveaxis(values, -1, 0), strict=True))

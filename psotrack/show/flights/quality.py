"""Quality of tracks: quantities over time, and a table with one row per camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from psotrack.recordings import Recording, view_in_images
from psotrack.show.flights.flight import FlightTracks, TrackedFlight
from psotrack.support import drone_colour

if TYPE_CHECKING:
    from pandas import DataFrame


#: Quantities over time: their names with units, and what they mean.
QUANTITIES = {
    "error_mm": ("error (mm)", "Distance of each drone of the reference from its track."),
    "score": ("score", "How well the images fit the position of each drone, from 0 to 1."),
    "deviation_mm": ("std (mm)", "Standard deviation of each position in space, as the run states it."),
    "cameras": ("cameras", "Number of cameras that see each drone."),
}


@dataclass(frozen=True)
class Quantity:
    """A quantity over time, with a line per drone.

    Attributes:
        key: one of `QUANTITIES`.
        frame, time_s: (rows,), numbers and times of the instants, seconds.
        values: (rows, lines), NaN where it is not known.
        names: name of each drone: of the tracks, or of the reference for errors.
        colours: colour of each line, as #rrggbb.
    """

    key: str
    frame: Int[np.ndarray, "rows"]
    time_s: Float[np.ndarray, "rows"]
    values: Float[np.ndarray, "rows lines"]
    names: tuple[str, ...]
    colours: tuple[str, ...]


def quantities(flight: TrackedFlight, tracks: FlightTracks) -> Iterator[Quantity]:
    """The quantities over time that are known of tracks, in the order of `QUANTITIES`."""
    errors, flown = flight.errors(tracks), tracks.trajectories
    if errors is not None:
        table = errors.pivot(index=["frame", "time_s"], columns="drone", values="error_m").sort_index()
        frame, time_s = (table.index.get_level_values(level).to_numpy() for level in ("frame", "time_s"))
        names = tuple(f"{name}" for name in table.columns)
        # Drones of the reference are others than those of the tracks.
        colours = tuple(
            tracks.colours[0] if tracks.group else drone_colour(index) for index in range(len(names))
        )
        yield Quantity("error_mm", frame, time_s, 1e3 * table.to_numpy(float), names, colours)
    deviation_mm = None if flown.covariance_m2 is None else deviations_mm(flown.covariance_m2)
    found = {"score": flown.fitness, "deviation_mm": deviation_mm, "cameras": flown.num_cameras}
    for key, values in found.items():
        if values is not None:
            shown = np.where(flown.seen, values, np.nan).astype(np.float64)
            yield Quantity(key, flown.frame, flown.time_s, shown, flown.drones, tracks.colours)


def deviations_mm(covariance_m2: Float[np.ndarray, "*points 3 3"]) -> Float[np.ndarray, "*points"]:
    """Standard deviations of positions in space, mm: roots of the sums of their variances along the axes."""
    return 1e3 * np.sqrt(np.maximum(np.trace(covariance_m2, axis1=-2, axis2=-1), 0.0))


def camera_quality(tracks: FlightTracks, recording: Recording) -> DataFrame:
    """One row per camera of the recording's rig.

    Returns:
        Columns `camera`; `frames`, fraction of the instants at which the camera has a frame; `in_view`, share of the
        drones' positions that are in its image; `width_px`, median width of the drones' boxes in its image; `noise_px`,
        the noise of the drones' places in its image as the run learned it, root mean square of columns and rows;
        `explained`, share of its detections that are near a track; `left_out`, number of its frames that the run left
        out. NaN where unknown.
    """
    import pandas as pd

    views = view_in_images(recording, tracks.trajectories, tracks.size_m)
    names, record = recording.rig.names, tracks.record
    widths_px = pd.DataFrame((views.boxes_px[..., 2] - views.boxes_px[..., 0]).reshape(-1, len(names)))
    errors = {} if record is None else record.camera_errors.get("cameras", {})
    noise_px = pd.DataFrame(
        [errors.get(name, {}).get("noise_px") or (np.nan, np.nan) for name in names], dtype=float
    )
    explained = {} if record is None else record.explained.get("cameras", {})
    left_out = {} if record is None else record.left_out
    return pd.DataFrame(
        {
            "camera": names,
            "frames": (views.frame >= 0).mean(axis=0),
            "in_view": widths_px.count() / max(int(tracks.trajectories.seen.sum()), 1),
            "width_px": widths_px.median(),
            "noise_px": np.sqrt(noise_px.pow(2).mean(axis=1)),
            "explained": pd.Series([explained.get(name) for name in names], dtype=float),
            "left_out": [sum(stop - first for first, stop in left_out.get(name, ())) for name in names],
        }
    )

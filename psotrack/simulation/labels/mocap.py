"""Positions of the mocap markers on the drones, without noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.simulation.flights.planning import frame_times_s
from psotrack.simulation.scene import Scene
from psotrack.simulation.world.drones import marker_cross


def mocap_markers_m(scene: Scene, num_frames: int) -> Float[np.ndarray, "frames drones 4 3"]:
    """(frames, drones, 4, 3), world, metres: markers A, B, C and D of each drone in the middle of each exposure."""
    time_s = frame_times_s(scene.scenario, num_frames)
    markers = [
        marker_cross(shape, number) @ flight.rotation(time_s).swapaxes(-1, -2)
        + flight.position_m(time_s)[:, None]
        for number, (shape, flight) in enumerate(zip(scene.models, scene.flights, strict=True), start=1)
    ]
    return np.stack(markers, axis=1)

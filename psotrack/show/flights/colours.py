"""Colours of drones by their status, and how the status of a track is shown where the file has none."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int, UInt8

from psotrack.trajectories import Status, Trajectories

#: How much white is mixed into the colours of predicted drones, from 0 to 1.
_COASTING_LIGHTER = 0.65
#: Colour of drones that are lost.
_LOST_RGB = (150, 150, 150)


def statuses(trajectories: Trajectories) -> Int[np.ndarray, "frames drones"]:
    """Status of each drone in each frame; of tracks without status: lost where there is no position."""
    if trajectories.status is not None:
        return trajectories.status
    return np.where(trajectories.seen, int(Status.TRACKED), int(Status.LOST))


def colour_rgb(colour: str, lighter: float = 0.0) -> tuple[int, int, int]:
    """A colour #rrggbb as red, green and blue, 0 to 255.

    Args:
        colour: the colour.
        lighter: share of white that is mixed into the colour, for dark backgrounds.
    """
    red, green, blue = (
        round(int(colour[place : place + 2], 16) * (1 - lighter) + 255 * lighter) for place in (1, 3, 5)
    )
    return red, green, blue


def status_rgb(status: int, rgb: tuple[int, int, int]) -> tuple[int, int, int]:
    """Colour by status: the drone's own where it is tracked, paler where it is predicted, grey where it is lost.

    Args:
        status: a value of `Status`.
        rgb: the drone's own colour.
    """
    if status == Status.LOST:
        return _LOST_RGB
    lighter = _COASTING_LIGHTER if status == Status.COASTING else 0.0
    red, green, blue = (round(part + (255 - part) * lighter) for part in rgb)
    return red, green, blue


def status_colours(
    status: Int[np.ndarray, " rows"], rgb: tuple[int, int, int]
) -> UInt8[np.ndarray, "rows 3"]:
    """(rows, 3), the colour of a drone by its status in each row; see `status_rgb`."""
    return np.array([status_rgb(each, rgb) for each in Status], np.uint8)[status]

"""The status of a drone in a frame."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """Status of a drone in a frame."""

    #: The position comes from a measurement.
    TRACKED = 0
    #: The position is predicted over a gap without measurements.
    COASTING = 1
    #: The position is the last prediction, for display only; the drone counts as missed.
    LOST = 2

    @property
    def label(self) -> str:
        """Word in tables and files."""
        return self.name.lower()

"""What a calibration of a rig gives: the cameras, their figures, and sentences, as a record, text, a table and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from psotrack.calibration.rig.adjustment import CalibratedRig
from psotrack.geometry import Rig
from psotrack.support import html_block, html_table, text_table


@dataclass(frozen=True, repr=False)
class RigCalibration:
    """A rig that was calibrated; its text is what `psotrack calibrate rig` prints.

    Attributes:
        rig: the cameras.
        cameras: figures of each camera, by its name.
        table: headings, and a row of texts of each camera.
        before: sentences above the table.
        after: sentences below the table.
        more: what JSON has besides the cameras.
        calibrated: how the rig fits each view of a board; None without a board.
        path: file of the rig; None where it is not written.
    """

    rig: Rig
    cameras: Mapping[str, dict[str, Any]]
    table: tuple[Sequence[str], Sequence[Sequence[str]]]
    before: Sequence[str] = ()
    after: Sequence[str] = ()
    more: Mapping[str, Any] = field(default_factory=dict)
    calibrated: CalibratedRig | None = None
    path: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """The figures of the cameras, and the sentences."""
        path = None if self.path is None else str(self.path)
        return {"rig": path, "cameras": dict(self.cameras), **self.more}

    def __str__(self) -> str:
        path = () if self.path is None else (f"{self.path}",)
        return "\n".join([*self.before, text_table(*self.table), *self.after, *path])

    def __repr__(self) -> str:
        return f"RigCalibration({', '.join(self.rig.names)}; {'; '.join(self.after)})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the table of the cameras, and the sentences."""
        return html_block("; ".join(self.after), html_table(*self.table))

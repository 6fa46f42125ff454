"""The options of a camera's rolling shutter, and what is said about it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from psotrack.errors import SettingsError

if TYPE_CHECKING:
    from psotrack.inside_out import LineTime, RollingShutter


@dataclass(frozen=True)
class ShutterOptions:
    """The rolling shutter of a camera.

    Attributes:
        line_time_s: time from the exposure of one row to that of the next row, seconds; 0 is a global shutter; None:
            estimated from the video.
        readout_s: time that the camera takes to expose all rows of a frame one after the other, seconds; instead of
            `line_time_s`.
    """

    line_time_s: Annotated[float, Meta(extra={"metavar": "S"})] | None = None
    readout_s: Annotated[float, Meta(extra={"metavar": "S"})] | None = None

    def of(self, rows: int, fps: float | None) -> RollingShutter | None:
        """The shutter; None if neither option is given.

        Args:
            rows: height of the images, pixels.
            fps: frames per second; None if unknown.

        Raises:
            SettingsError: both are given, or a value is negative, not finite, or longer than a frame allows.
        """
        from psotrack.inside_out import RollingShutter

        if self.line_time_s is not None and self.readout_s is not None:
            raise SettingsError(
                "--line-time",
                expected="--line-time or --readout, which say the same",
                found=f"both, {self.line_time_s:g} and {self.readout_s:g}",
            )
        by_row = self.readout_s is None
        name, value = ("--line-time", self.line_time_s) if by_row else ("--readout", self.readout_s)
        if value is None:
            return None
        largest = math.inf if fps is None else 1 / fps / (rows if by_row else 1)
        if not 0 <= value <= largest * (1 + 1e-9) or not math.isfinite(value):
            of_frame = "" if fps is None else f", the time between two frames at {fps:g} frames per second"
            of_rows = f" ({rows} rows take {value * rows:.3g} s)" if by_row and value > largest else ""
            most = "" if fps is None else f" to {largest:.3g} s"
            share = f", {rows} rows in {1 / fps:.3g} s" if by_row and fps is not None else ""
            raise SettingsError(
                name,
                expected=f"0{most or ' s or more'}{share}{of_frame}",
                found=f"{value:g}{of_rows}",
                remedy="the unit is seconds",
            )
        return RollingShutter(value if by_row else value / rows)


def shutter_content(
    given: RollingShutter | None, used: RollingShutter | None, shown: LineTime | None, rows: int
) -> dict[str, Any]:
    """The shutter as JSON.

    Args:
        given: the shutter that the options give; None if it was to be estimated.
        used: the shutter that was used; None is a global shutter of which nothing is known.
        shown: what the video shows; None if it was not estimated.
        rows: height of the images, pixels.
    """
    line_time_s = 0.0 if used is None else used.line_time_s
    return {
        "line_time_s": line_time_s,
        "line_time_std_s": 0.0 if used is None else used.std_s,
        "readout_s": line_time_s * rows,
        "reference_row": (rows - 1) / 2,
        "source": "given"
        if given is not None
        else "estimated"
        if shown is not None and shown.is_shown
        else "assumed",
        "shown": None
        if shown is None
        else {
            "line_time_s": shown.line_time_s,
            "std_s": shown.std_s,
            "frames": shown.frames,
            "is_sure": shown.is_shown,
            "contradicts": given is not None and shown.contradicts(given.line_time_s),
        },
    }


def shutter_sentence(given: RollingShutter | None, shown: LineTime | None) -> str:
    """What the video shows of the shutter, in words; empty where it confirms a global shutter or a given line time.

    Args:
        given: the shutter that the options give.
        shown: what the video shows.
    """
    if shown is None:
        return ""
    found = (
        f"{1e6 * shown.line_time_s:.2f} +- {1e6 * shown.std_s:.2f} us from row to row"
        f" ({1e3 * shown.readout_s:.1f} ms for a frame)"
    )
    if given is not None:
        if not shown.contradicts(given.line_time_s):
            return ""
        return (
            f"warning: the video shows a shutter of {found}, not the given {1e6 * given.line_time_s:.2f} us;"
            " the covariances include the difference"
        )
    if shown.rolls:
        return f"rolling shutter of {found}, estimated from {shown.frames} frames; poses are those of the middle row"
    if shown.is_shown:
        return ""
    return (
        "the motion does not show whether the shutter rolls"
        f" ({1e3 * shown.readout_s:.1f} +- {1e3 * shown.readout_std_s:.1f} ms for a frame): taken as global, with this"
        " uncertainty; --line-time states it"
    )

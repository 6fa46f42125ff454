"""Picture of the coverage: where each camera saw corners of the board, and how large their residuals are."""

from __future__ import annotations

from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from psotrack.calibration.rig.adjustment import CalibratedRig
from psotrack.support import save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Largest number of pictures in a row.
_COLUMNS = 4
#: Residuals from this multiple of the median residual on have the brightest colour.
_BRIGHT = 4.0


def save_coverage(path: Path, calibrated: CalibratedRig, *, force: bool) -> None:
    """Save a PNG with the corners in each camera's image, coloured by their residuals.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    count = len(calibrated.rig)
    columns = min(count, _COLUMNS)
    rows = ceil(count / columns)
    brightest_px = _BRIGHT * float(np.nanmedian(calibrated.residual_px))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel in panels[count:]:
            panel.axis("off")
        for index, (panel, name) in enumerate(zip(panels, calibrated.rig.names, strict=False)):
            residual = calibrated.residual_px[index]
            seen = np.isfinite(residual)
            order = np.argsort(residual[seen])
            pixels = calibrated.views.corners_px[index][seen][order]
            dots = panel.scatter(
                pixels[:, 0],
                pixels[:, 1],
                c=residual[seen][order],
                s=3,
                vmin=0,
                vmax=brightest_px,
                cmap="viridis",
            )
            width, height = calibrated.views.image_size_wh[index]
            panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", title=name)
        figure.colorbar(dots, ax=panels.tolist(), label="residual (px)")

    save_figure(path, (3.2 * columns + 1.0, 2.4 * rows + 0.3), draw, force)

"""Pictures of what a network finds while it is trained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from psotrack.foreground.learning.samples import Samples
from psotrack.foreground.network import Network, findings
from psotrack.support import COLOURS, save_figure

#: Number of frames in a picture.
_NUM_FRAMES = 4


def draw_findings(
    network: Network, samples: Sequence[Samples], history: list[dict[str, float]], out: Path
) -> None:
    """Draw frames with the pixels and boxes that a network finds in them, and the losses of all epochs.

    Raises:
        OutputError: the picture cannot be written.
    """

    def draw(figure: Figure) -> None:
        axes = figure.subplots(2, _NUM_FRAMES + 1)
        for number, (above, below) in enumerate(axes.T[:-1]):
            each = samples[number * len(samples) // _NUM_FRAMES]
            index = len(each) // 2
            share, boxes, confidence = findings(
                network, each.image[index], None if each.by_boxes else each.background
            )
            above.imshow(np.asarray(each.image[index])[..., ::-1])
            below.imshow(share, vmin=0, vmax=1, cmap="gray")
            for (x0, y0, x1, y1), told in zip(boxes, confidence, strict=True):
                above.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color=COLOURS[1]))
                above.text(x0, y0, f"{told:.2f}", color=COLOURS[1], fontsize=7, va="bottom")
        for axis in axes[:, :-1].flat:
            axis.set_axis_off()
        epochs = np.arange(1, len(history) + 1)
        losses, shares = axes[:, -1]
        losses.plot(epochs, [each["learned"] for each in history], label="loss, training")
        losses.plot(epochs, [each["loss"] for each in history], label="loss, validation")
        losses.set_yscale("log")
        for name in ("pixel_f", "recall"):
            shares.plot(epochs, [each[name] for each in history], label=name.replace("_", " "))
        shares.set(xlabel="epoch", ylim=(0, 1))
        false = shares.twinx()
        per_frame = [each["false_per_frame"] for each in history]
        false.plot(epochs, per_frame, color=COLOURS[3], linestyle=":", label="false boxes a frame (right)")
        for axis, place in ((losses, "upper right"), (shares, "lower left"), (false, "lower right")):
            axis.legend(loc=place, fontsize=7)

    save_figure(out, (16, 4), draw, force=True)

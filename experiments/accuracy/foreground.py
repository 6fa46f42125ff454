"""Foreground in pictures that change: psotrack's background models beside OpenCV's MOG2 and KNN.

    python experiments/accuracy/foreground.py --data data --real data/real
    python experiments/accuracy/foreground.py --data data --out office --real data/real --clips "CDnet office"

For clips with masks: F-measure, precision and recall over all pixels of the clip. For clips with boxes of one drone:
share of the frames in which a blob's middle lies in the box, blobs beside the box per frame, and the median distance
and overlap of the found blob. Each peer has a grid of learning rates and thresholds; "-1" is OpenCV's own rate. Writes
a row per clip and model (CSV), the record (JSON) and a picture (PNG), and prints each model's means over the clips: a
peer's best single setting is its row with the best mean F-measure.

--real names a folder of public repositories, as OWNER/NAME (see `_foreground_clips`); without it, recorded clips are
left out. The boxes of the recorded drones need the package mcos-decoder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from _foreground_clips import Clip, Image, Mask, clips
from _runs import parser, save_rows, start

from psotrack.foreground.silhouettes import ForegroundSettings, Living, Mog2, learning_step

Model = Callable[[list[Image]], Iterable[Mask]]
#: MOG2's and KNN's label of shadows.
_SHADOW = 127
#: Smallest blob that counts, pixels: the same for all models.
_LEAST_PX = 4
#: Clips of the picture, and the frame of each.
PICTURED = {"simulated, restless": 120, "clouds, fast": 200, "swaying trees": 240, "drone 030": 120}


def main() -> None:
    """Measure all models on all clips, write the result and the picture, and print each model's means."""
    options = parser(__doc__)
    options.add_argument("--real", type=Path, help="folder of the recordings, as OWNER/NAME")
    options.add_argument("--clips", nargs="+", help="names of the clips; all without")
    options.add_argument("--models", nargs="+", help="names of the models; all without")
    options.add_argument(
        "--picture", type=Path, default=Path("experiments/pictures/foreground.png"), help="the picture"
    )
    chosen = options.parse_args()
    cv2.setNumThreads(1)
    run = start("foreground")
    made = clips(chosen.data, chosen.real)
    clip = lru_cache(maxsize=1)(lambda name: made[name]())
    rows = [
        (f"{name}, {model_name}", lambda name=name, model_name=model_name: row(name, clip(name), model_name))
        for name in chosen.clips or made
        for model_name in chosen.models or models()
    ]
    table = save_rows(
        run, rows, chosen.data, chosen.out, draw=lambda _: draw(made, chosen.picture), files=[chosen.picture]
    )
    print(table.groupby("model", sort=False).mean(numeric_only=True).round(3).to_string())


def row(clip_name: str, clip: Clip, model_name: str) -> dict[str, Any]:
    """Measures of one model on one clip."""
    kind = "masks" if clip.boxes is None else "boxes"
    masks = models()[model_name](clip.frames)
    return {"clip": clip_name, "truth": kind, "model": model_name, **score(masks, clip)}


def models() -> dict[str, Model]:
    """psotrack's models at the images' size, and the grids of OpenCV's, by name."""
    settings = ForegroundSettings(working_reduction=1, min_blob_px=9)
    found: dict[str, Model] = {
        name: lambda frames, model=model: model.foreground(  # type: ignore[misc]
            frames[:: learning_step(len(frames), settings)], frames
        )
        for name, model in (("psotrack mog2", Mog2(settings)), ("psotrack living", Living(settings)))
    }
    for rate in (0.002, 0.01, -1):
        for threshold in (16, 50, 100):
            found[f"MOG2 {rate} {threshold}"] = _opencv(cv2.createBackgroundSubtractorMOG2, rate, threshold)
        for threshold in (400, 1500):
            found[f"KNN {rate} {threshold}"] = _opencv(cv2.createBackgroundSubtractorKNN, rate, threshold)
    return found


def _opencv(
    create: Callable[[int, float, bool], cv2.BackgroundSubtractor], rate: float, threshold: float
) -> Model:
    def masks(frames: list[Image]) -> Iterator[Mask]:
        model = create(500, threshold, True)
        for frame in frames:
            mask = np.asarray(model.apply(frame, learningRate=rate))
            mask[mask == _SHADOW] = 0
            yield mask

    return masks


def draw(made: Mapping[str, Callable[[], Clip]], path: Path) -> None:
    """Draw a frame of some clips, each beside its masks by psotrack's two background models."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [name for name in PICTURED if name in made]
    figure = Figure(figsize=(9, 1.75 * len(shown)), layout="constrained")
    FigureCanvasAgg(figure)
    for name, axes in zip(shown, figure.subplots(len(shown), 3, squeeze=False), strict=True):
        clip, index = made[name](), PICTURED[name]
        drawn = {"the frame": cv2.cvtColor(clip.frames[index], cv2.COLOR_BGR2RGB)} | {
            f"{model}": next(islice(models()[f"psotrack {model}"](clip.frames), index, None))
            for model in ("mog2", "living")
        }
        for (title, image), panel in zip(drawn.items(), axes, strict=True):
            panel.imshow(image, cmap="gray", vmin=0, vmax=255)
            panel.set(xticks=[], yticks=[], title=title if name == shown[0] else "")
        axes[0].set_ylabel(name, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def score(masks: Iterable[Mask], clip: Clip) -> dict[str, float]:
    """Measures of the masks of all frames of a clip."""
    return _score_masks(masks, clip) if clip.boxes is None else _score_boxes(masks, clip.boxes)


def _score_masks(masks: Iterable[Mask], clip: Clip) -> dict[str, float]:
    right = false = missed = 0
    for index, mask in enumerate(masks):
        if index not in clip.masks:
            continue
        truth, seen = clip.masks[index], mask > 127
        right += np.count_nonzero(seen & (truth == 255))
        false += np.count_nonzero(seen & ((truth == 0) | (truth == 50)))
        missed += np.count_nonzero(~seen & (truth == 255))
    return {
        "F": 2 * right / max(1, 2 * right + false + missed),
        "precision": right / max(1, right + false),
        "recall": right / max(1, right + missed),
    }


def _score_boxes(masks: Iterable[Mask], boxes: np.ndarray) -> dict[str, float]:
    found, false_blobs, distance_px, overlap = [], [], [], []
    for mask, box in zip(masks, boxes, strict=True):
        stats = cv2.connectedComponentsWithStats((mask > 127).astype(np.uint8), connectivity=8)[2][1:]
        stats = stats[stats[:, cv2.CC_STAT_AREA] >= _LEAST_PX].astype(float)
        corner, size = stats[:, :2], stats[:, 2:4]
        beside = ((corner >= box[:2] + box[2:]) | (corner + size <= box[:2])).any(axis=-1) | np.isnan(box[0])
        false_blobs.append(np.count_nonzero(beside))
        if np.isnan(box[0]):
            continue
        off_px = corner + size / 2 - box[:2] - box[2:] / 2
        inside = (np.abs(off_px) <= box[2:] / 2).all(axis=-1)
        found.append(inside.any())
        if inside.any():
            best = np.flatnonzero(inside)[stats[inside, cv2.CC_STAT_AREA].argmax()]
            shared = np.minimum(corner[best] + size[best], box[:2] + box[2:]) - np.maximum(
                corner[best], box[:2]
            )
            area = shared.clip(0).prod()
            distance_px.append(np.hypot(*off_px[best]))
            overlap.append(area / (size[best].prod() + box[2:].prod() - area))
    return {
        "found": float(np.mean(found)),
        "false blobs": float(np.mean(false_blobs)),
        "distance px": float(np.median(distance_px)) if distance_px else np.nan,
        "IoU": float(np.median(overlap)) if overlap else np.nan,
    }


if __name__ == "__main__":
    main()

"""Foreground in pictures that change: psotrack's background models beside OpenCV's MOG2 and KNN.

    python experiments/accuracy/foreground.py --out foreground.csv
    python experiments/accuracy/foreground.py --clips "CDnet office" --out office.csv

For clips with masks: F-measure, precision and recall over all pixels of the clip. For clips with boxes of one drone:
share of the frames in which a blob's middle lies in the box, blobs beside the box per frame, and the median distance
and overlap of the found blob. Each peer has a grid of learning rates and thresholds; "-1" is OpenCV's own rate. The
last table shows each setting's means over the clips: a peer's best single setting is its row with the best mean.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from _foreground_clips import Clip, Image, Mask, clips

from psotrack.silhouettes import ForegroundSettings
from psotrack.silhouettes.foreground import Mog2, learning_step
from psotrack.silhouettes.living_background import Living

Model = Callable[[list[Image]], Iterable[Mask]]
#: MOG2's and KNN's label of shadows.
_SHADOW = 127
#: Smallest blob that counts, pixels: the same for all models.
_LEAST_PX = 4


def main() -> None:
    """Measure all models on all clips, print the tables and write them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="CSV file of all rows")
    parser.add_argument("--clips", nargs="+", help="names of the clips; all without")
    parser.add_argument("--models", nargs="+", help="names of the models; all without")
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the simulated scenes")
    args = parser.parse_args()
    print(f"OpenCV {cv2.__version__}, one thread")
    cv2.setNumThreads(1)
    rows = []
    for name, make in clips(args.data).items():
        if args.clips and name not in args.clips:
            continue
        clip = make()
        for model_name, model in models().items():
            if args.models and model_name not in args.models:
                continue
            rows.append({"clip": name, "model": model_name, **score(model(clip.frames), clip)})
            print(
                "  ".join(
                    f"{value:.3f}" if isinstance(value, float) else value for value in rows[-1].values()
                )
            )
    table = pd.DataFrame(rows)
    print(table.groupby("model", sort=False).mean(numeric_only=True).round(3).to_string())
    if args.out:
        table.to_csv(args.out, index=False)


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

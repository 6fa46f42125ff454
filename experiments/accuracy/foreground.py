"""How well background models and detectors find drones, and how well the swarm tracks by each of them.

    python experiments/accuracy/accuracy.py foreground --data data --real REAL
    python experiments/accuracy/accuracy.py foreground --data data --methods living lab.model --only calm

Cases: four simulated drones in a calm room, in restless surroundings, that hover at first, that stay where they are,
before cameras that tremble, in light that flickers; three in a hall; with --rendered FOLDER a sequence of
`experiments/rendered.py`; with --real clips of drones and birds before cameras that stand still. None of them is in the
training of the package's network. A blob or a box is a drone's if its middle is in the drone's box. With --detector
MODEL.onnx the clips are also searched by a network of others (`psotrack detect`), whose boxes of all classes count.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from reference import GATE_M, figures_of, psotrack

from psotrack.foreground.detection import DetectorSettings, detect_drones, find_detector
from psotrack.foreground.learning.samples import gather
from psotrack.foreground.silhouettes import (
    ForegroundSettings,
    SilhouetteSettings,
    find_background,
    learning_step,
    scaled_settings,
)
from psotrack.recordings import open_video, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import RESTLESS, SimulationSettings, change_scenario, scenario, simulate
from psotrack.support import evenly_spread, progress_bar
from psotrack.trajectories import read_trajectories

METHODS = ("mog2", "living", "network")
#: Places of the four drones of S02_D4_A that stay, metres, and how far away the second place is of those that move.
PLACES_M = ((1.2, 0.9, 1.6), (-1.2, 0.9, 1.2), (1.2, -0.9, 1.9), (-1.2, -0.9, 1.5))
AWAY_M = (0.0, -0.7, 0.3)
#: Name of each simulated case: its preset, and changes of it.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "calm": ("S02_D4_A", {}),
    "restless": ("S02_D4_A", dict(RESTLESS)),
    "hovers at first": ("S02_D4_A", {}),
    "stays": ("S02_D4_A", {}),
    "trembles": ("S02_D4_A", {}),
    "flickers": ("S02_D4_A", {"imaging.exposure": [0.75, 1.33], "imaging.exposure_period_s": 0.37}),
    "hall": ("S12_D3", {}),
}
for number, place_m in enumerate(PLACES_M):
    there_m = [a + b for a, b in zip(place_m, AWAY_M, strict=True)]
    moves = {"kind": "waypoints", "points_m": [place_m, there_m], "speed_m_s": 0.6, "hover_s": 4.0}
    CASES["hovers at first"][1][f"drones[{number}].flight"] = moves
    stays = {"kind": "orbit", "centre_m": place_m, "radius_m": [0.0, 0.0], "period_s": 10.0}
    CASES["stays"][1][f"drones[{number}].flight"] = stays
#: Largest tremble, pixels of a frame half as large as usual.
TREMBLE_PX = 2.0
#: Frames of each camera, and cameras, whose pixels and blobs are compared.
PER_CAMERA, CAMERAS = 10, 4
CLIPS = "DroneDetectionThesis/Drone-detection-dataset"
#: Clips before cameras that stand still, and their groups. The network's rule of still boxes was chosen on the first
#: group, not on the second.
STILL = (
    dict.fromkeys((f"V_DRONE_{number:03d}" for number in (4, 20, 30, 50, 60, 70, 80, 90, 100)), "drones")
    | dict.fromkeys((f"V_DRONE_{number:03d}" for number in (2, 6, 8, 12, 16, 18, 22, 24)), "held out")
    | dict.fromkeys(("V_BIRD_022", "V_BIRD_040"), "birds")
)
#: Least confidences of boxes.
CONFIDENCES = (0.2, 0.25, 0.3, 0.4)
#: Pixels by which the box of a clip is too small at most.
MARGIN_PX = 3


def case(name: str, data: Path) -> Path:
    """The folder of a simulated case, which is made if it is missing."""
    preset, changes = CASES[name]
    root = data / "foreground" / name.replace(" ", "_")
    folder = root / "Simulated_Data" / preset
    if not folder.exists():
        recipe = change_scenario(scenario(preset), changes)
        settings = SimulationSettings(num_frames=200, scale=0.5, seed=7, onboard=False)
        simulate(recipe, root, settings, report=progress_bar)
        if name == "trembles":
            for number, path in enumerate(sorted(folder.glob("*.avi"))):
                tremble(path, np.random.default_rng(number))
    return folder


def tremble(path: Path, random: np.random.Generator) -> None:
    """Move each frame of a video by up to 2 pixels."""
    video = open_video(path)
    frames = [np.asarray(frame) for frame in read_frames(video)]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), video.fps, video.image_size_wh)
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 95)
    for frame in frames:
        by = np.column_stack([np.eye(2), random.uniform(-TREMBLE_PX, TREMBLE_PX, 2)])
        writer.write(cv2.warpAffine(frame, by, video.image_size_wh, borderMode=cv2.BORDER_REPLICATE))
    writer.release()


def tracked(name: str, method: str, made: Callable[[], Path], data: Path) -> dict[str, Any]:
    """A sequence by a background model: pixels and blobs beside the masks, and tracks beside the truth."""
    folder = made()
    tracks = data / "foreground" / "tracks" / f"{name}-{Path(method).stem}.csv".replace(" ", "_")
    tracks.parent.mkdir(parents=True, exist_ok=True)
    where = ("--out", str(tracks), "--cache", str(data / "silhouettes"), "--force")
    refused = psotrack("track", str(folder), "--background", method, *where)
    recording = open_recording(folder)
    row = {"case": name, "method": method, **_pixels(recording.usable(), method, data)}
    if refused:
        return {**row, "tracks": 0, "missed": 1.0}
    found = read_trajectories(tracks)
    assert recording.truth is not None
    figures = figures_of(found, recording.truth, GATE_M)
    kept = ("mean_mm", "centred_mm", "missed", "switches", "false_tracks")
    return {**row, "tracks": found.num_drones, **{each: figures[each] for each in kept}}


def _pixels(recording: Any, method: str, data: Path) -> dict[str, float]:
    settings = scaled_settings(SilhouetteSettings(background=method), recording)
    samples = gather(recording, settings, per_camera=PER_CAMERA, cache=data / "silhouettes", jobs=2)
    counts, blobs = np.zeros(3), np.zeros(4)
    for video, shown in list(zip(recording.videos.values(), samples, strict=True))[:CAMERAS]:
        frames = evenly_spread(video.num_frames, PER_CAMERA).tolist()
        learning = read_frames(video, learning_step(video.num_frames, settings))
        found_in = enumerate(find_background(method, settings).foreground(learning, read_frames(video)))
        masks = [mask for number, mask in found_in if number in frames]
        for mask, covered, truth in zip(masks, shown.covered, shown.box_px, strict=True):
            mask = np.zeros(covered.shape, np.uint8) if mask is None else mask
            mask = cv2.resize(mask, covered.shape[::-1], interpolation=cv2.INTER_LINEAR)
            found, drawn = mask >= 128, covered >= 128
            counts += (found & drawn).sum(), found.sum(), drawn.sum()
            blobs += _matched(_blobs(mask), truth[np.isfinite(truth[:, 0])], margin_px=1)
    return {
        "pixel_f": 2 * counts[0] / max(counts[1:].sum(), 1),
        "recall": blobs[0] / max(blobs[1], 1),
        "false_per_frame": blobs[2] / blobs[3],
    }


def _blobs(mask: np.ndarray) -> np.ndarray:
    boxes = cv2.connectedComponentsWithStats((mask >= 128).astype(np.uint8))[2][1:, :4].astype(float)
    return np.hstack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])


def _matched(boxes: np.ndarray, truth: np.ndarray, margin_px: int) -> tuple[int, int, int, int]:
    """Drones that have a box, drones, boxes that are no drone's, and one frame."""
    middle = (boxes[:, None, :2] + boxes[:, None, 2:]) / 2
    inside = ((middle >= truth[:, :2] - margin_px) & (middle <= truth[:, 2:] + margin_px)).all(axis=-1)
    return int(inside.any(axis=0).sum()), len(truth), int((~inside.any(axis=1)).sum()), 1


@lru_cache(maxsize=1)
def _detected(method: str, layout: Any, path: Path) -> Any:
    # All that is asked for with a higher confidence is among these boxes: a video is searched once.
    detector = find_detector(method, DetectorSettings(size=640, confidence=0.03, layout=layout))
    return detect_drones(detector, path.stem, open_video(path))


def clip(name: str, method: str, confidence: float, real: Path, layout: Any) -> dict[str, Any]:
    """A clip by a background model, or by the boxes of a detector with a least confidence."""
    from mcos_decoder import load_groundtruth  # pip install mcos-decoder

    path = real / CLIPS / "Data" / "Video_V" / f"{name}.mp4"
    video = open_video(path)
    labels = load_groundtruth(str(path.with_name(f"{name}_LABELS.mat")))
    labels = labels[max(len(labels) - video.num_frames, 0) :]
    total = np.zeros(4)
    if confidence:
        told = map(_detected(method, layout, path).in_frame, range(video.num_frames))
        found = (each.xyxy[each.confidence >= confidence] for each in told)
    else:
        settings = ForegroundSettings(reduction=1, working_reduction=1, min_blob_px=9)
        learning = read_frames(video, learning_step(video.num_frames, settings))
        masks = find_background(method, settings).foreground(learning, read_frames(video))
        found = (np.zeros((0, 4)) if mask is None else _blobs(mask) for mask in masks)
    for boxes, label in zip(found, labels, strict=False):
        box = np.zeros((0, 4)) if label is None or STILL[name] == "birds" else np.array([label], float)
        total += _matched(boxes, np.hstack([box[:, :2], box[:, :2] + box[:, 2:]]), MARGIN_PX)
    shown = f"{method} boxes at {confidence}" if confidence else method
    counts = dict(zip(("found", "drones", "false", "frames"), total.astype(int).tolist(), strict=True))
    return {"case": name, "group": STILL[name], "method": shown, **counts}


def add_options(options: argparse.ArgumentParser) -> None:
    """Options of this study."""
    options.add_argument("--methods", nargs="*", default=METHODS, help="background models")
    options.add_argument("--only", nargs="+", default=[""], help="cases whose names begin so [default: all]")
    options.add_argument("--rendered", type=Path, help="a sequence of experiments/rendered.py")
    options.add_argument("--detector", help="an ONNX file of others, for the clips")
    options.add_argument("--layout", help="the layout of its output, if it does not tell")


def rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Name and function of each row."""

    def is_chosen(name: str) -> bool:
        return any(name.startswith(each) for each in options.only)

    folders: dict[str, Callable[[], Path]] = {name: partial(case, name, options.data) for name in CASES}
    if options.rendered is not None:
        folders["rendered"] = lambda: options.rendered
    for name, folder in folders.items():
        for method in options.methods if is_chosen(name) else ():
            yield f"{name}:{method}", partial(tracked, name, method, folder, options.data)
    if options.real is None:
        return
    networks = [each for each in options.methods if each not in ("mog2", "living")]
    searches = [(each, 0.0, None) for each in options.methods]
    searches += [(each, confidence, None) for each in networks for confidence in CONFIDENCES]
    if options.detector:
        searches += [(options.detector, confidence, options.layout) for confidence in (0.03, 0.1, 0.3)]
    for name in filter(is_chosen, STILL):
        for method, least, layout in searches:
            yield f"{name}:{method}:{least}", partial(clip, name, method, least, options.real, layout)


def show(table: pd.DataFrame, options: argparse.Namespace) -> None:
    """Print the sequences, and the clips group by group."""
    settings: dict[str, Any] = {"float_format": "{:.3f}".format, "na_rep": "-"}
    if "pixel_f" in table:
        sequences = table[table.pixel_f.notna()].dropna(axis=1, how="all")
        print(sequences.to_string(index=False, **settings))
    if "found" in table:
        clips = table[table.found.notna()]
        clips = clips.groupby(["group", "method"])[["found", "drones", "false", "frames"]].sum()
        clips = clips.assign(recall=clips.found / clips.drones, false_per_frame=clips["false"] / clips.frames)
        print(clips.to_string(**settings))

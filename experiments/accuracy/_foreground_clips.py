"""Clips for the study of foreground: drawn scenes with masks, and other people's recordings with masks or boxes.

Recordings lie in a folder of public repositories, as OWNER/NAME (see `recordings`); a recording that is not there is
left out. The boxes of the drone recordings are MATLAB objects, read by the package mcos-decoder. The scenes of the
simulator have one camera and the masks of all drones; a scene is simulated if it is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.recordings import read_frames
from psotrack.recordings.datasets import open_recording, read_masks
from psotrack.simulation import RESTLESS, SimulationSettings, change_scenario, scenario, simulate

Image = UInt8[np.ndarray, "height width 3"]
Mask = UInt8[np.ndarray, "height width"]

#: Recorded drones whose camera stands still, of DroneDetectionThesis/Drone-detection-dataset (CC0).
DRONES = ("004", "020", "030", "050", "060", "070", "080", "090", "100")

#: Changes of the simulated scenes, by name of the clip.
SCENES: Mapping[str, Mapping[str, Any]] = {
    "simulated, calm": {},
    "simulated, exposure": {name: value for name, value in RESTLESS.items() if "exposure" in name},
    "simulated, lamp": {name: value for name, value in RESTLESS.items() if "lamp" in name},
    "simulated, foliage": {name: value for name, value in RESTLESS.items() if "foliage" in name},
    "simulated, screen": {name: value for name, value in RESTLESS.items() if "screen" in name},
    "simulated, restless": RESTLESS,
    "simulated, person": {"surroundings.person": 0.5},
}
#: The camera of the simulated scenes: one of the laboratory's; frames, and scale of the images.
_CAMERA = {"position_m": [-4.7, -3.7, 3.1], "target_m": [0.1, 0.0, 1.25]}
_FRAMES, _SCALE = 200, 0.5


@dataclass(frozen=True)
class Clip:
    """Frames and what is true in them.

    Attributes:
        frames: the frames, BGR.
        masks: (height, width) by frame number: 255 foreground, 0 and 50 (shadow) background, other values do not count.
        boxes: (frames, 4), left, top, width and height of the only object, pixels; NaN where there is none; None for a
            clip with masks.
    """

    frames: list[Image]
    masks: dict[int, Mask] = field(default_factory=dict)
    boxes: Float[np.ndarray, "frames 4"] | None = None


def clips(data: Path, real: Path | None) -> dict[str, Callable[[], Clip]]:
    """All clips that can be made on this machine, by name; a clip is made when it is called.

    Args:
        data: folder of the simulated scenes.
        real: folder of the public repositories with recordings; None is no recording.
    """
    drawn: dict[str, Callable[[], Clip]] = {
        "swaying trees": swaying_trees,
        "clouds, slow": lambda: clouds(seed=0, drift_px=0.35, contrast=70),
        "clouds, fast": lambda: clouds(seed=2, drift_px=0.8, contrast=110),
    }
    scenes = {
        name: lambda name=name, changes=changes: _simulated(data / "foreground" / name, changes)
        for name, changes in SCENES.items()
    }
    return drawn | scenes | (dict(recordings(real)) if real else {})  # type: ignore[arg-type]


def recordings(root: Path) -> Iterator[tuple[str, Callable[[], Clip]]]:
    """Recordings of other people in a folder of public repositories."""
    office = root / "e-sha/Background-subtraction/data/office"
    if office.is_dir():
        yield "CDnet office", lambda: _office(office)
    videos = root / "DroneDetectionThesis/Drone-detection-dataset/Data/Video_V"
    for number in DRONES:
        path = videos / f"V_DRONE_{number}.mp4"
        if path.is_file():
            yield f"drone {number}", lambda path=path: _drone(path)  # type: ignore[misc]


def smooth_noise(
    rng: np.random.Generator, height: int, width: int, *, octaves: int, cells: int, persistence: float
) -> Float[np.ndarray, "height width"]:
    """Random values from 0 to 1, smooth at several scales."""
    values = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        columns = min(width, cells * 2**octave) + 2
        rows = min(height, max(2, columns * height // width)) + 2
        coarse = rng.standard_normal((rows, columns)).astype(np.float32)
        values += persistence**octave * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return (values - values.min()) / np.ptp(values)


def clouds(
    *,
    seed: int,
    drift_px: float,
    contrast: float,
    num_frames: int = 300,
    size_wh: tuple[int, int] = (640, 512),
) -> Clip:
    """A quadcopter that shrinks from 60 to 8 px in front of clouds that drift and change; encoded as MPEG-4."""
    (width, height), rng = size_wh, np.random.default_rng(seed)
    shape = (height + 100, width + int(1.2 * drift_px * num_frames) + 100)
    early, late = (smooth_noise(rng, *shape, octaves=6, cells=4, persistence=0.55) for _ in range(2))
    rise = np.linspace(0, 1, height)[:, None, None]
    blue = np.array([210.0, 170.0, 130.0]) + rise * [-20.0, 10.0, 40.0]
    frames, boxes = [], []
    for index in range(num_frames):
        time = index / (num_frames - 1)
        seen = [
            cv2.warpAffine(field_, np.array([[1, 0, -speed * drift_px * index], [0, 1, -30.0]]), size_wh)
            for field_, speed in ((early, 1.0), (late, 1.15))
        ]
        white = np.clip((seen[0] * (1 - time) + seen[1] * time - 0.42) * 3.2, 0, 1)[..., None]
        image = (
            blue * (1 - white)
            + (np.array([235.0, 232.0, 230.0]) - 0.6 * (contrast - 30) * (1 - white)) * white
        )
        middle = (
            width * (0.5 + 0.36 * np.sin(2 * np.pi * time * 1.7 + seed)),
            height * (0.5 + 0.3 * np.sin(2 * np.pi * time * 1.1 + 1 + seed)),
        )
        drone = quadcopter(size_wh, middle, 60 * (8 / 60) ** time, 0.05 * np.sin(index / 5))
        image = image * (1 - drone[..., None]) + 42.0 * drone[..., None]
        image += rng.normal(0, 2, image.shape)
        frames.append(np.clip(image, 0, 255).astype(np.uint8))
        boxes.append(cv2.boundingRect((drone > 0.5).astype(np.uint8)))
    return Clip([_coded(frame) for frame in frames], boxes=np.array(boxes, float))


def quadcopter(
    size_wh: tuple[int, int], middle_px: tuple[float, float], across_px: float, angle_rad: float
) -> Float[np.ndarray, "height width"]:
    """Share of each pixel that a quadcopter with four rotors covers, drawn eight times finer and averaged."""
    finer, half = 8, int(across_px) + 4
    left, top = int(middle_px[0]) - half, int(middle_px[1]) - half
    canvas = np.zeros((2 * half * finer, 2 * half * finer), np.uint8)
    x, y = (finer * (middle_px[0] - left), finer * (middle_px[1] - top))
    reach = across_px * finer / 2
    for arm in range(4):
        angle = angle_rad + np.pi / 4 + arm * np.pi / 2
        tip = (int(x + reach * 0.62 * np.cos(angle)), int(y + reach * 0.36 * np.sin(angle)))
        cv2.line(canvas, (int(x), int(y)), tip, 255, max(2, int(across_px * finer * 0.09)))
        cv2.ellipse(canvas, tip, (int(reach * 0.36) + 1, int(reach * 0.12) + 1), 0, 0, 360, 255, -1)
    cv2.ellipse(canvas, (int(x), int(y)), (int(reach * 0.35), int(reach * 0.22)), 0, 0, 360, 255, -1)
    drawn = cv2.resize(canvas, (2 * half, 2 * half), interpolation=cv2.INTER_AREA).astype(float) / 255
    width, height = size_wh
    padded = np.zeros((height + 4 * half, width + 4 * half))
    padded[top + 2 * half : top + 4 * half, left + 2 * half : left + 4 * half] = drawn
    return padded[2 * half : -2 * half, 2 * half : -2 * half]


def swaying_trees(num_frames: int = 280, size_wh: tuple[int, int] = (160, 120)) -> Clip:
    """Trees that sway all the time, and a person who walks past them in the last quarter; encoded as JPEG."""
    (width, height), rng = size_wh, np.random.default_rng(0)
    leaves = smooth_noise(rng, height + 60, width + 60, octaves=7, cells=8, persistence=0.75)[..., None]
    tree = leaves * np.array([90.0, 140.0, 100.0]) + np.array([20.0, 40.0, 20.0])
    phase = 6 * smooth_noise(rng, height, width, octaves=3, cells=3, persistence=0.55)
    crown = (smooth_noise(rng, height, width, octaves=6, cells=6, persistence=0.7) > 0.42).astype(np.float32)
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    frames, masks = [], {}
    for index in range(num_frames):
        sway = (3 * np.sin(0.35 * index + phase) + 1.5 * np.sin(0.83 * index + 2 * phase)) * (
            1 - 0.6 * rows / height
        )
        sway = sway.astype(np.float32)
        seen = cv2.remap(
            tree.astype(np.float32), columns + 30 + sway, rows + 30 + 0.4 * sway, cv2.INTER_LINEAR
        )
        there = cv2.remap(
            crown, columns + sway, rows + 0.4 * sway, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        image = seen * there[..., None] + np.array([220.0, 210.0, 200.0]) * (1 - there[..., None])
        person = np.zeros((height, width), np.uint8)
        if index >= 0.75 * num_frames:
            x = int(-20 + (index / num_frames - 0.75) / 0.25 * 0.8 * width)
            cv2.ellipse(person, (x, height - 35), (16, 45), 0, 0, 360, 255, -1)
            cv2.circle(person, (x, height - 85), 11, 255, -1)
            cloth = np.array([60.0, 50.0, 110.0]) + rng.normal(0, 6, (np.count_nonzero(person), 1))
            image[person > 0] = cloth
        image += rng.normal(0, 3, image.shape)
        frames.append(_coded(np.clip(image, 0, 255).astype(np.uint8)))
        if person.any():
            masks[index] = person
    return Clip(frames, masks)


def _simulated(root: Path, changes: Mapping[str, Any]) -> Clip:
    """A flight of four drones before one camera; all drones are foreground, and nothing else."""
    recipe = change_scenario(scenario("S02_D4_A"), {"cameras": [_CAMERA], **changes})
    folder = root / "Simulated_Data" / recipe.name
    if not folder.exists():
        settings = SimulationSettings(num_frames=_FRAMES, scale=_SCALE, seed=1, onboard=False)
        simulate(recipe, root, settings)
    ((name, video),) = open_recording(folder).videos.items()
    frames = list(read_frames(video))
    with read_masks(folder) as masks:
        drones = range(1, len(recipe.drones) + 1)
        seen = [
            np.any([masks.mask(name, drone, index) for drone in drones], axis=0)
            for index in range(len(frames))
        ]
    return Clip(frames, {index: 255 * mask.astype(np.uint8) for index, mask in enumerate(seen)})


def _coded(image: Image) -> Image:
    """The image after a JPEG of quality 85."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))


def _office(folder: Path) -> Clip:
    """CDnet's office, scored in every fifth frame from 570, as its authors score it from there on."""
    frames = [cv2.imread(str(path)) for path in sorted((folder / "input").iterdir())]
    truth = {int(path.stem[2:]) - 1: path for path in (folder / "groundtruth").iterdir()}
    chosen = [index for index in sorted(truth) if index >= 569 and index % 5 == 0]
    return Clip(frames, {index: cv2.imread(str(truth[index]), cv2.IMREAD_GRAYSCALE) for index in chosen})


def _drone(path: Path) -> Clip:
    from mcos_decoder.groundtruth import load_groundtruth

    reader, frames = cv2.VideoCapture(str(path)), []
    while (frame := reader.read()[1]) is not None:
        frames.append(frame)
    labels = load_groundtruth(path.with_name(f"{path.stem}_LABELS.mat"))
    nothing = (np.nan,) * 4
    boxes = np.array([nothing if label is None else label for label in labels])
    # Many tables begin with one entry too many, which is empty.
    boxes = boxes[len(boxes) - len(frames) if np.isnan(boxes[0, 0]) and len(boxes) > len(frames) else 0 :][
        : len(frames)
    ]
    missing = np.full((len(frames) - len(boxes), 4), np.nan)
    return Clip(frames, boxes=np.concatenate([boxes, missing]))

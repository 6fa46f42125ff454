"""Pictures of each effect of the simulator's cameras: the same view without and with the effect.

    python experiments/simulation/effects.py --out experiments/pictures

Writes effect_NAME.png for the effects of `scenarios.Imaging` and `scenarios.Surroundings` that one frame shows. Where
an effect is mild by default it is exaggerated; the titles say by how much. The record of all pictures is
results/effects.json beside this file; --only writes none.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import msgspec
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from psotrack.geometry import project
from psotrack.simulation import CameraRenderer, Scenario, build, scenario
from psotrack.simulation.scenarios import (
    CameraPlace,
    Drone,
    Harmonic,
    Harmonics,
    Imaging,
    Limits,
    Surroundings,
    Variation,
)

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

Vector = tuple[float, float, float]

#: Settings of a camera without effects; each picture switches on one effect.
OFF = Imaging(
    antialiasing=True,
    shutter_s=0,
    lens_blur_px=0.5,
    shadows=False,
    reflections=0,
    exposure_drift=0,
    white_balance_drift=0,
    flicker=0,
    read_noise=0,
    shot_noise=0,
)
#: Nothing changes around the drones.
CALM = Surroundings()
ANYWHERE = Limits(
    max_speed_m_s=100,
    max_acceleration_m_s2=100,
    max_tilt_deg=80,
    min_distance_m=0,
    lower_m=(-4.9, -3.9, 0.01),
    upper_m=(4.9, 3.9, 3.9),
)
HIGH = CameraPlace(position_m=(-4.7, -3.7, 3.1), target_m=(0.1, 0.0, 1.25))
LOW = CameraPlace(position_m=(-4.4, -2.2, 0.7), target_m=(0.4, 0.6, 0.35))
ABOVE = CameraPlace(position_m=(-4.6, -3.3, 2.3), target_m=(-2.8, -1.9, 0.0))
TITLE_PX, GAP_PX, FONT_PX = 24, 6, 14


@dataclass(frozen=True)
class Pair:
    """A view without and with an effect.

    Attributes:
        name: name of the effect.
        titles: titles of the pictures without and with the effect.
        with_it: imaging settings with the effect, where they differ from `OFF`.
        without: imaging settings without the effect, where they differ from `OFF`.
        around: what changes around the drones with the effect.
        time_s: time of the frame.
        at_m: position of the drone, world.
        aim_m: middle of the view, world; None: the drone.
        velocity_m_s: velocity of the drone along x.
        camera: the camera.
        model: name of the drone model.
        paint_bgr: paint of the drone.
        size_px: width and height of the view before magnification; None: the whole image.
        zoom: factor of the magnification, without interpolation.
        difference: factor of the difference in a third picture; 0: no third picture.
    """

    name: str
    titles: tuple[str, str]
    with_it: dict[str, Any] = field(default_factory=dict)
    without: dict[str, Any] = field(default_factory=dict)
    around: Surroundings = CALM
    time_s: float = 0.0
    at_m: Vector = (0.4, -0.6, 1.2)
    aim_m: Vector | None = None
    velocity_m_s: float = 0.0
    camera: CameraPlace = HIGH
    model: str = "x_frame"
    paint_bgr: Vector = (0.03, 0.03, 0.03)
    size_px: tuple[int, int] | None = (96, 64)
    zoom: float = 4
    difference: int = 0


PAIRS = (
    Pair(
        "antialiasing",
        ("one sample per pixel", "antialiasing"),
        without={"antialiasing": False, "lens_blur_px": 0},
        with_it={"antialiasing": True, "lens_blur_px": 0},
    ),
    Pair(
        "motion_blur",
        ("shutter_s = 0, at 4 m/s", "shutter_s = 1/50, at 4 m/s"),
        with_it={"shutter_s": 1 / 50},
        velocity_m_s=4.0,
        size_px=(110, 64),
    ),
    Pair(
        "lens_blur",
        ("lens_blur_px = 0", "lens_blur_px = 1.5"),
        without={"lens_blur_px": 0},
        with_it={"lens_blur_px": 1.5},
    ),
    Pair(
        "shadows",
        ("shadows off", "shadows on: one for each lamp"),
        with_it={"shadows": True},
        at_m=(-2.9, -2.0, 0.3),
        aim_m=(-2.9, -2.0, 0.1),
        camera=ABOVE,
        model="tall_cross",
        paint_bgr=(0.3, 0.25, 0.22),
        size_px=(290, 200),
        zoom=1,
        difference=6,
    ),
    Pair(
        "reflections",
        ("reflections off", "reflections = 0.04, looking across the floor"),
        with_it={"reflections": 0.04},
        at_m=(-1.6, -0.6, 0.22),
        aim_m=(-1.6, -0.6, 0.0),
        camera=LOW,
        model="tall_cross",
        size_px=(360, 250),
        zoom=1,
    ),
    Pair(
        "noise",
        ("no noise", "read_noise = 2, shot_noise = 6 (twice the default)"),
        with_it={"read_noise": 2.0, "shot_noise": 6.0},
    ),
    Pair(
        "jpeg",
        ("jpeg_quality = 0: none", "jpeg_quality = 25"),
        with_it={"jpeg_quality": 25},
    ),
    *(
        Pair(name, titles, around=around, time_s=time_s, size_px=None, zoom=0.25)
        for name, titles, around, time_s in (
            ("lamp", ("lamp on", "lamp_drop = 0.25, off"), Surroundings(lamp_drop=0.25, lamp_s=(0.0,)), 0.0),
            ("screen", ("no screen", "screen = 0.025"), Surroundings(screen=0.025), 1.0),
            ("foliage", ("no foliage", "foliage = 0.025"), Surroundings(foliage=0.025), 1.0),
            ("person", ("nobody", "person = 0.5"), Surroundings(person=0.5), 4.0),
        )
    ),
)


def scene_of(pair: Pair, imaging: Imaging, around: Surroundings) -> Scenario:
    """Scenario of the laboratory with one camera and one drone."""
    period_s = 3.0
    swing_m = pair.velocity_m_s * period_s / (2 * np.pi)
    flight = Harmonics(
        centre_m=pair.at_m, terms=(Harmonic(amplitude_m=(swing_m, 0.0, 0.0), period_s=period_s),)
    )
    drone = Drone(flight=flight, model=pair.model, paint_bgr=pair.paint_bgr, yaw_deg=15.0, yaw_sway_deg=0.0)
    return msgspec.structs.replace(
        scenario("S02_D4_A"),
        num_frames=1,
        cameras=(pair.camera,),
        drones=(drone,),
        limits=ANYWHERE,
        variation=Variation(phase_deg=0, centre_m=0, size=0, period=0, yaw_deg=0),
        imaging=imaging,
        surroundings=around,
    )


def view(pair: Pair, changes: dict[str, Any], around: Surroundings) -> np.ndarray:
    """(rows, columns, 3), RGB: the part of the frame that the picture shows."""
    scene = build(scene_of(pair, msgspec.structs.replace(OFF, **changes), around))
    frame = CameraRenderer(scene, 0).frame(round(pair.time_s * scene.scenario.fps))
    if pair.size_px is None:
        whole = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        return cv2.resize(whole, None, fx=pair.zoom, fy=pair.zoom, interpolation=cv2.INTER_AREA)
    (x, y), _ = project(scene.rig.cameras[0], np.array(pair.aim_m or pair.at_m))
    width, height = pair.size_px
    left, top = int(x) - width // 2, int(y) - height // 2
    part = cv2.cvtColor(frame[top : top + height, left : left + width], cv2.COLOR_BGR2RGB)
    return cv2.resize(part, None, fx=pair.zoom, fy=pair.zoom, interpolation=cv2.INTER_NEAREST)


def picture(pair: Pair) -> Image.Image:
    """Picture of both views side by side under their titles."""
    views = [view(pair, pair.without, CALM), view(pair, pair.with_it, pair.around)]
    titles = [*pair.titles]
    if pair.difference:
        views.append(cv2.convertScaleAbs(cv2.absdiff(*views), alpha=pair.difference))
        titles.append(f"difference x {pair.difference}")
    height, width = views[0].shape[:2]
    page = Image.new("RGB", (len(views) * (width + GAP_PX) - GAP_PX, height + TITLE_PX), "white")
    font = ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", FONT_PX)
    for index, (shown, title) in enumerate(zip(views, titles, strict=True)):
        left = index * (width + GAP_PX)
        page.paste(Image.fromarray(shown), (left, TITLE_PX))
        ImageDraw.Draw(page).text((left + 2, 3), title, fill="black", font=font)
    return page


def save_small(page: Image.Image, path: Path) -> None:
    """Save as PNG of 256 colours: a quarter of the size, without a visible difference."""
    page.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/pictures"), help="folder of the pictures"
    )
    parser.add_argument(
        "--results", type=Path, default=Path(__file__).parent / "results", help="folder of the record"
    )
    names = [pair.name for pair in PAIRS]
    parser.add_argument(
        "--only", nargs="*", choices=names, metavar="NAME", help=f"some of {', '.join(names)}"
    )
    options = parser.parse_args()
    run = _results.Run("effects")
    options.out.mkdir(parents=True, exist_ok=True)
    for pair in PAIRS:
        if not options.only or pair.name in options.only:
            path = options.out / f"effect_{pair.name}.png"
            if pair.size_px is None:
                # 256 colours are too few for a whole image: skin becomes grey.
                picture(pair).save(path, optimize=True)
            else:
                save_small(picture(pair), path)
    if not options.only:
        run.save(options.results, files=[options.out / f"effect_{name}.png" for name in names])


if __name__ == "__main__":
    main()

"""Pictures of each effect of the simulator's cameras: the same view without and with the effect.

    python experiments/simulation/effects.py --out experiments/pictures

Writes effect_NAME.png for each effect of `scenarios.Imaging` and `scenarios.Surroundings`. Where an effect is mild by
default it is exaggerated; the titles say by how much. The record of all pictures is results/effects.json beside this
file; --only writes none.
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
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from psotrack.geometry import project
from psotrack.simulation import RESTLESS, CameraRenderer, Scenario, build, scenario
from psotrack.simulation.imaging.sensor import Sensor, flicker_gain
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
from psotrack.support import COLOURS

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

Vector = tuple[float, float, float]

#: Settings of a camera without effects; each picture switches on one effect.
OFF = Imaging(
    antialiasing=True,
    shutter_s=0,
    lens_blur_px=0.5,
    shadows=False,
    contact_shadows=False,
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
NEAR = CameraPlace(position_m=(-4.5, -3.2, 0.8), target_m=(-3.0, -2.2, 0.0))
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
        "contact_shadows",
        ("contact_shadows off, standing", "contact_shadows on, standing"),
        with_it={"contact_shadows": True},
        at_m=(-3.0, -2.2, 0.045),
        aim_m=(-3.0, -2.2, 0.045),
        camera=NEAR,
        model="x_frame",
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
            ("clouds", ("no clouds", "clouds = 0.6"), Surroundings(clouds=0.6), 4.0),
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


def curves(rows: int) -> tuple[Figure, list[Any]]:
    figure = Figure(figsize=(7.6, 2.1 * rows), dpi=100, layout="constrained")
    axes = [figure.add_subplot(rows, 1, index + 1) for index in range(rows)]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.axhline(1.0, color="#9aa3ad", linewidth=0.8)
        ax.set_ylabel("light, relative")
    return figure, axes


def drift() -> Figure:
    """Draw two minutes of slow changes of three cameras: the defaults, and the automatic exposure of --restless."""
    default = Imaging()
    figure, (exposure, white, automatic) = curves(3)
    time_s = np.linspace(0, 120, 600)
    for camera, colour in zip(range(3), COLOURS, strict=False):
        alone = msgspec.structs.replace(OFF, exposure_drift=default.exposure_drift)
        sensor = Sensor(alone, 0, camera, (8, 8))
        exposure.plot(
            time_s, [sensor.gains(t)[1] for t in time_s], color=colour, label=f"camera {camera + 1}"
        )
    alone = msgspec.structs.replace(OFF, white_balance_drift=default.white_balance_drift)
    sensor = Sensor(alone, 0, 0, (8, 8))
    gains = np.array([sensor.gains(t) for t in time_s])
    for channel, (name, colour) in enumerate(
        (("blue", COLOURS[0]), ("green", COLOURS[2]), ("red", COLOURS[1]))
    ):
        white.plot(time_s, gains[:, channel], color=colour, label=name)
    exposure.set_title(f"exposure_drift = {default.exposure_drift}", fontsize=10)
    white.set_title(f"white_balance_drift = {default.white_balance_drift}, camera 1", fontsize=10)
    limits = {key.removeprefix("imaging."): value for key, value in RESTLESS.items() if "exposure" in key}
    swings = msgspec.structs.replace(OFF, **limits)
    for camera, colour in zip(range(3), COLOURS, strict=False):
        sensor = Sensor(swings, 1, camera, (8, 8))
        gains = [sensor.gains(t)[1] for t in time_s]
        automatic.plot(time_s, gains, color=colour, label=f"camera {camera + 1}")
    stated = ", ".join(f"{name} = {value}" for name, value in limits.items())
    automatic.set_title(stated, fontsize=10)
    automatic.set_xlabel("time in s")
    for ax in (exposure, white, automatic):
        ax.legend(ncols=3, fontsize=8, frameon=False, loc="upper right")
        ax.margins(y=0.25)
    return figure


def flicker() -> Figure:
    """Draw the light of the lamps, and the brightness of frames with three shutter times."""
    figure, (lamps, frames) = curves(2)
    shown = Imaging(flicker=0.3, shutter_s=0)
    time_s = np.linspace(0, 0.08, 800)
    lamps.plot(1000 * time_s, [flicker_gain(shown, 0.0, t) for t in time_s], color=COLOURS[0])
    for frame in range(3):
        middle_ms = 40 * frame
        lamps.axvspan(max(middle_ms - 4, 0), min(middle_ms + 4, 80), color="#dde1e6", linewidth=0)
    lamps.set_title("lamps at 2 x 50.02 Hz, flicker = 0.3; grey: exposures of 1/125 s at 25 fps", fontsize=10)
    lamps.set_xlabel("time in ms")
    frame_s = np.arange(1500) / 25
    for shutter, colour in ((500, COLOURS[1]), (125, COLOURS[0]), (100, COLOURS[2])):
        setting = msgspec.structs.replace(shown, shutter_s=1 / shutter)
        gains = [flicker_gain(setting, 0.0, t) for t in frame_s]
        frames.plot(frame_s, gains, color=colour, label=f"1/{shutter} s")
    frames.set_title("brightness of frames: a slow beat, none at all at 1/100 s", fontsize=10)
    frames.set_xlabel("time in s")
    frames.legend(ncols=3, fontsize=8, frameon=False, loc="upper right")
    frames.margins(y=0.25)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/pictures"), help="folder of the pictures"
    )
    parser.add_argument(
        "--results", type=Path, default=Path(__file__).parent / "results", help="folder of the record"
    )
    curves_of = {"drift": drift, "flicker": flicker}
    names = [*(pair.name for pair in PAIRS), *curves_of]
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
    for name, draw in curves_of.items():
        if not options.only or name in options.only:
            canvas = FigureCanvasAgg(draw())
            canvas.draw()
            save_small(
                Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"),
                options.out / f"effect_{name}.png",
            )
    if not options.only:
        run.save(options.results, files=[options.out / f"effect_{name}.png" for name in names])


if __name__ == "__main__":
    main()

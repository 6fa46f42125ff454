"""Pictures of the five drone models at one scale, and their silhouettes in a camera at 5 m.

    python experiments/simulation/drone_models.py --out experiments/pictures

Writes drone_models.png: each model from three sides, with its full size, rotors included. The record is
results/drone_models.json beside this file.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
from matplotlib.figure import Figure

from psotrack.geometry import look_at, make_camera
from psotrack.simulation import Scene, build, scenario
from psotrack.simulation.imaging import posing, raster, sensor
from psotrack.simulation.scenarios import Drone, Harmonic, Harmonics, Variation
from psotrack.simulation.world.drones import MODELS, DroneModel, disc_fans

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

PAINT_BGR = {
    "x_frame": (0.03, 0.03, 0.03),
    "x_frame_racer": (0.05, 0.04, 0.40),
    "camera_drone": (0.35, 0.34, 0.32),
    "hexacopter": (0.70, 0.70, 0.68),
    "tall_cross": (0.35, 0.14, 0.04),
}
#: Azimuth and elevation from which a picture is taken; x is ahead of the drone, and upwards when seen from above.
VIEWS = {"three-quarter": (38.0, 27.0), "from the left": (90.0, 0.0), "from above": (180.0, 89.9)}
#: Distance of a long lens with nearly parallel rays, and distance and focal length of a camera of the scenarios.
FAR_M, NEAR_M, FOCAL_PX = 8.0, 5.0, 1156.3
PX_PER_M, WIDTH_M, OVERSAMPLED = 480, 0.92, 3
GREY, INK = 0.72, "#2b313a"


def hovering() -> Scene:
    """Scene with one drone of each model, horizontal and still, in the laboratory."""
    drones = []
    for x, name in zip((-2.0, -1.0, 0.0, 1.0, 2.0), MODELS, strict=True):
        still = Harmonics(
            centre_m=(x, 0.0, 2.0), terms=(Harmonic(amplitude_m=(0.0, 0.0, 0.0), period_s=9.0),)
        )
        drones.append(Drone(flight=still, model=name, paint_bgr=PAINT_BGR[name], yaw_sway_deg=0.0))
    recipe = msgspec.structs.replace(
        scenario("S02_D4_A"),
        drones=tuple(drones),
        variation=Variation(phase_deg=0.0, centre_m=0.0, size=0.0, period=0.0, yaw_deg=0.0),
    )
    return build(recipe, scale=0.2)


def view_of(
    at_m: np.ndarray, height_m: float, angles: tuple[float, float], distance_m: float, focal_px: float
) -> raster.RasterView:
    """A window of `WIDTH_M` by `height_m` around a point, seen from one side."""
    azimuth, elevation = np.radians(angles)
    away = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    R, t = look_at(at_m + distance_m * away, at_m)
    width, height = (round(side * focal_px / distance_m) for side in (WIDTH_M, height_m))
    K = np.array([[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return raster.full_view(raster.pinhole(make_camera(R=R, t_m=t, K=K, image_size_wh=(width, height))))


def portrait(scene: Scene, drone: int, height_m: float, angles: tuple[float, float]) -> np.ndarray:
    """RGB picture of one model in front of grey."""
    at_m = scene.positions_m(1)[0, drone]
    view = view_of(at_m, height_m, angles, FAR_M, OVERSAMPLED * PX_PER_M * FAR_M)
    posed = posing.pose(scene, drone, np.zeros(1))
    seen = posing.sample(view, [posed], 0, np.full(view.shape, raster.FAR_M, np.float32))
    light = seen[..., :3] + GREY * seen[..., 3:]
    small = cv2.resize(light, None, fx=1 / OVERSAMPLED, fy=1 / OVERSAMPLED, interpolation=cv2.INTER_AREA)
    return sensor.develop(small)[..., ::-1]


def silhouette(model: DroneModel, height_m: float, angles: tuple[float, float]) -> np.ndarray:
    """Silhouette in a camera at 5 m: black where the body or a rotor disc is."""
    view = view_of(np.zeros(3), height_m, angles, NEAR_M, FOCAL_PX)
    triangles = np.concatenate([model.triangles_m, disc_fans(model)])
    shown, depth = raster.empty_buffers(view)
    raster.draw(view, triangles, np.ones((len(triangles), 1, 3)), shown, depth)
    return 1 - shown[..., 0]


def over_all_m(model: DroneModel) -> np.ndarray:
    """(3,), size along x, y and z, rotors included, metres."""
    return np.ptp(np.concatenate([model.triangles_m, disc_fans(model)]).reshape(-1, 3), axis=0)


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/pictures"), help="folder of the picture"
    )
    parser.add_argument(
        "--results", type=Path, default=Path(__file__).parent / "results", help="folder of the record"
    )
    options = parser.parse_args()
    run = _results.Run("drone_models")
    scene = hovering()
    heights_m = [max(over_all_m(model)[0], 0.36) + 0.06 for model in scene.models]
    figure = Figure(figsize=(15.0, 10.6), layout="constrained")
    grid = figure.subplots(
        len(MODELS), 2 * len(VIEWS), height_ratios=heights_m, width_ratios=[1.0] * 3 + [0.5] * 3
    )
    for row, (name, model) in enumerate(zip(MODELS, scene.models, strict=True)):
        for column, (title, angles) in enumerate(VIEWS.items()):
            large, small = grid[row, column], grid[row, len(VIEWS) + column]
            picture = portrait(scene, row, heights_m[row], angles)
            large.imshow(picture)
            large.plot([20, 20 + 0.1 * PX_PER_M], [len(picture) - 14] * 2, color=INK, linewidth=3)
            large.text(20, len(picture) - 22, "0.1 m", fontsize=8, color=INK)
            small.imshow(silhouette(model, heights_m[row], angles), cmap="gray", interpolation="nearest")
            if row == 0:
                large.set_title(title, fontsize=11)
                small.set_title(f"at 5 m, {title}", fontsize=9)
        x, y, z = 100 * over_all_m(model)
        grid[row, 0].text(12, 26, name, fontsize=12, weight="bold", color=INK)
        grid[row, 0].text(12, 46, f"{x:.0f} x {y:.0f} x {z:.0f} cm over all", fontsize=8, color=INK)
    for axes in grid.flat:
        axes.set(xticks=[], yticks=[])
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "drone_models.png"
    figure.savefig(path, dpi=80)
    run.save(options.results, files=[path])
    print(path)


if __name__ == "__main__":
    main()

"""Preview: one page with images and plans of a scenario, drawn in seconds, before any video is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.geometry import project_visible
from psotrack.simulation.imaging.onboard import OnboardRenderer
from psotrack.simulation.imaging.renderer import CameraRenderer
from psotrack.simulation.scenarios import Scenario, count_frames
from psotrack.simulation.scene import Scene, build
from psotrack.simulation.world.halls import HALLS
from psotrack.support import (
    Advance,
    Report,
    drone_colour,
    map_in_processes,
    no_progress,
    refuse_to_overwrite,
    save_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Width of one image, pixels.
_PICTURE_PX = 480
#: Times of the images of one camera, as shares of the sequence's length.
_MOMENTS = (0.05, 0.5, 0.95)
_PER_ROW = 6
#: Width of the page, and height of the plans, inches.
_PAGE_WIDTH, _PLANS_HEIGHT = 16.0, 5.4


@dataclass(frozen=True)
class _View:
    """Images of one camera to draw.

    Attributes:
        scene: the scene.
        camera: index of the static camera, or of the drone that carries the camera.
        onboard: whether the camera is on board of a drone.
        frames: numbers of the frames.
    """

    scene: Scene
    camera: int
    onboard: bool
    frames: tuple[int, ...]


def save_preview(
    path: str | Path,
    scenario: Scenario,
    *,
    num_frames: int | None = None,
    seed: int = 0,
    force: bool = False,
    jobs: int,
    report: Report = no_progress,
) -> Path:
    """Save a PNG with images of every static camera, images of several on-board cameras, and plans of the flights.

    Args:
        path: path of the PNG.
        scenario: the scenario to show.
        num_frames: number of first frames to show; None: all.
        seed: seed of the flights and the noise.
        force: whether to replace an existing file.
        jobs: number of cameras that are drawn at the same time.
        report: shows the progress in cameras.

    Returns:
        Path of the PNG.

    Raises:
        SettingsError: the scenario cannot be built, or has fewer frames than `num_frames`.
        InputError: a mesh or a recorded flight cannot be used.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    num_frames = count_frames(scenario, num_frames)
    refuse_to_overwrite(path, force)
    scene = build(scenario, scale=_PICTURE_PX / scenario.image_size_wh[0], seed=seed)
    frames = tuple(int(moment * (num_frames - 1)) for moment in _MOMENTS)
    views = [_View(scene, index, False, frames) for index in range(len(scene.rig.names))]
    if scenario.onboard is not None:
        drones = range(min(len(scenario.drones), _PER_ROW))
        views += [_View(scene, drone, True, frames[:1]) for drone in drones]
    with report("preview", len(views)) as advance:
        images = map_in_processes(_draw, views, jobs=jobs, advance=advance)
    width, height = scenario.image_size_wh
    row_height = _PAGE_WIDTH / _PER_ROW * height / width + 0.22
    rows = -(-sum(map(len, images)) // _PER_ROW)

    def draw(figure: Figure) -> None:
        figure.suptitle(f"{scenario.name}  (seed {seed}): {scenario.description}", fontsize=13)
        heights = [_PLANS_HEIGHT, rows * row_height]
        above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
        position_m = scene.positions_m(num_frames)
        plan, elevation, facts = above.subplots(1, 3)
        _draw_plan(plan, scene, position_m, (0, 1))
        plan.legend(fontsize=7, ncols=5, loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False)
        _draw_plan(elevation, scene, position_m, (0, 2))
        _draw_facts(facts, scene, position_m)
        places = iter(below.subplots(rows, _PER_ROW, squeeze=False).flat)
        for view, seen in zip(views, images, strict=True):
            for frame, image in zip(view.frames, seen, strict=True):
                _draw_image(next(places), view, frame, image, position_m[frame])
        for unused in places:
            unused.set_axis_off()

    save_figure(path, (_PAGE_WIDTH, _PLANS_HEIGHT + rows * row_height), draw, force)
    return Path(path)


def _draw(view: _View, advance: Advance) -> list[UInt8[np.ndarray, "height width 3"]]:
    artist = (OnboardRenderer if view.onboard else CameraRenderer)(view.scene, view.camera)
    images = [artist.frame(frame) for frame in view.frames]
    advance(1)
    return images


def _draw_image(
    axes: Axes,
    view: _View,
    frame: int,
    image: UInt8[np.ndarray, "height width 3"],
    position_m: Float[np.ndarray, "drones 3"],
) -> None:
    """Draw an image, and circles about the drones in an image of a static camera."""
    axes.set_axis_off()
    axes.imshow(image[..., ::-1])
    if view.onboard:
        axes.set_title(f"on board of dron{view.camera + 1}, frame {frame}", fontsize=8)
        return
    axes.set_title(f"{view.scene.rig.names[view.camera]}, frame {frame}", fontsize=8)
    camera = view.scene.rig.cameras[view.camera]
    pixels, depth_m = map(np.asarray, project_visible(camera, position_m))
    height, width = image.shape[:2]
    inside = (depth_m > 0) & (pixels >= 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
    for drone in np.flatnonzero(inside).tolist():
        axes.plot(*pixels[drone], "o", mfc="none", mec=drone_colour(drone), markersize=9, linewidth=0.6)


def _draw_plan(
    axes: Axes, scene: Scene, position_m: Float[np.ndarray, "frames drones 3"], sides: tuple[int, int]
) -> None:
    """Draw the hall, the cameras and the flights, projected along the third axis."""
    length, width, height = HALLS[scene.scenario.hall].size_m
    low, high = np.array([[-length, -width, 0.0], [length, width, 2 * height]])[:, sides] / 2
    axes.plot([low[0], high[0], high[0], low[0], low[0]], [low[1], low[1], high[1], high[1], low[1]], "0.6")
    for drone, path_m in enumerate(np.moveaxis(position_m[..., sides], 1, 0)):
        axes.plot(*path_m.T, color=drone_colour(drone), linewidth=0.8, label=f"dron{drone + 1}")
        axes.plot(*path_m[0], "o", color=drone_colour(drone), markersize=5)
    for name, centre_m in zip(scene.rig.names, np.asarray(scene.rig.cameras.centre_world), strict=True):
        axes.plot(*centre_m[list(sides)], "^", color="0.2", markersize=6)
        axes.annotate(name, centre_m[list(sides)], fontsize=7)
    axes.set(aspect="equal", xlabel=f"{'xyz'[sides[0]]} (m)", ylabel=f"{'xyz'[sides[1]]} (m)")


def _draw_facts(axes: Axes, scene: Scene, position_m: Float[np.ndarray, "frames drones 3"]) -> None:
    """Draw the speed of every drone and the smallest distance between two drones, over time."""
    fps = scene.scenario.fps
    time_s = np.arange(len(position_m)) / fps
    speed = np.linalg.norm(np.diff(position_m, axis=0), axis=-1) * fps
    for drone, of_drone in enumerate(speed.T):
        axes.plot(time_s[1:], of_drone, color=drone_colour(drone), linewidth=0.8)
    first, second = np.triu_indices(position_m.shape[1], 1)
    if len(first):
        nearest_m = np.linalg.norm(position_m[:, first] - position_m[:, second], axis=-1).min(axis=1)
        label = f"smallest distance (minimum {nearest_m.min():.2f} m)"
        axes.plot(time_s, nearest_m, color="black", linewidth=1.6, label=label)
        axes.legend(fontsize=8, loc="upper right")
    axes.set(xlabel="time (s)", ylabel="speed (m/s), distance (m)", ylim=(0, None))
    axes.set_title(f"{position_m.shape[1]} drones, {len(position_m)} frames", fontsize=10)

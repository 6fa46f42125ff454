"""Preview: one page with images and plans of a scenario, drawn in seconds, before any video is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.geometry import Camera, project_visible
from psotrack.simulation.imaging.onboard import OnboardRenderer
from psotrack.simulation.imaging.renderer import CameraRenderer
from psotrack.simulation.scenarios import Scenario, count_frames
from psotrack.simulation.scene import Scene, build
from psotrack.simulation.world.halls import HALLS
from psotrack.support import (
    COLOURS,
    Advance,
    Report,
    atomic_write,
    map_in_processes,
    no_progress,
    refuse_to_overwrite,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Width of one image, pixels.
_PICTURE_PX = 480
#: Times of the images of one camera, as shares of the sequence's length.
_MOMENTS = (0.05, 0.5, 0.95)
_DPI = 100
#: Width of the page and height of the plans, inches.
_PAGE_WIDTH, _PLANS_HEIGHT = 16.0, 4.6
_PICTURES_PER_ROW = 6

Image = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class _Strip:
    """Images to draw: several frames of one static camera, or one frame of the on-board cameras of several drones.

    Attributes:
        scenario: the scenario.
        seed: seed of the flights and the noise.
        scale: scale of the image size.
        camera_index: index of the static camera; None for on-board cameras.
        frames: numbers of the frames.
        drones: indices of the drones whose on-board images are drawn.
    """

    scenario: Scenario
    seed: int
    scale: float
    camera_index: int | None
    frames: tuple[int, ...]
    drones: tuple[int, ...] = ()


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
    path = Path(path)
    refuse_to_overwrite(path, force)
    scale = _PICTURE_PX / scenario.image_size_wh[0]
    scene = build(scenario, scale=scale, seed=seed)
    frames = tuple(int(moment * (num_frames - 1)) for moment in _MOMENTS)
    strips = [_Strip(scenario, seed, scale, index, frames) for index in range(len(scene.rig.names))]
    if scenario.onboard is not None:
        drones = tuple(range(min(len(scenario.drones), _PICTURES_PER_ROW)))
        strips.append(_Strip(scenario, seed, scale, None, frames[:1], drones))
    with report("preview", len(strips)) as advance:
        pictures = map_in_processes(_draw, strips, jobs=jobs, advance=advance)
    figure = _page(scene, strips, pictures, num_frames)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)
    return path


def _draw(strip: _Strip, advance: Advance) -> list[Image]:
    scene = build(strip.scenario, scale=strip.scale, seed=strip.seed)
    if strip.camera_index is None:
        pictures = [OnboardRenderer(scene, drone).frame(strip.frames[0]) for drone in strip.drones]
    else:
        renderer = CameraRenderer(scene, strip.camera_index)
        pictures = [renderer.frame(frame) for frame in strip.frames]
    advance(1)
    return pictures


def _page(scene: Scene, strips: list[_Strip], pictures: list[list[Image]], num_frames: int) -> Figure:
    from matplotlib.figure import Figure

    scenario = scene.scenario
    shown = [
        (strip, picture, which)
        for strip, row in zip(strips, pictures, strict=True)
        for which, picture in enumerate(row)
    ]
    rows = -(-len(shown) // _PICTURES_PER_ROW)
    width, height = scenario.image_size_wh
    row_height = _PAGE_WIDTH / _PICTURES_PER_ROW * height / width + 0.22
    figure = Figure(figsize=(_PAGE_WIDTH, 0.8 + _PLANS_HEIGHT + rows * row_height), layout="constrained")
    above, below = figure.subfigures(
        2, 1, squeeze=False, height_ratios=[_PLANS_HEIGHT + 0.8, rows * row_height]
    )[:, 0]
    figure.suptitle(f"{scenario.name}  (seed {scene.seed}): {scenario.description}", fontsize=13)
    position_m = scene.positions_m(num_frames)
    plan, elevation, facts = above.subplots(1, 3, width_ratios=[1.2, 1.2, 1.0])
    for axes, across, up in ((plan, 0, 1), (elevation, 0, 2)):
        _draw_plan(axes, scene, position_m, across, up)
    _draw_facts(facts, scene, position_m)
    grid = below.subplots(rows, _PICTURES_PER_ROW, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, (strip, picture, which) in zip(grid.flat, shown, strict=False):
        axes.imshow(picture[..., ::-1])
        if strip.camera_index is None:
            axes.set_title(f"on board of dron{strip.drones[which] + 1}, frame {strip.frames[0]}", fontsize=8)
        else:
            frame = strip.frames[which]
            axes.set_title(f"{scene.rig.names[strip.camera_index]}, frame {frame}", fontsize=8)
            _mark_drones(axes, scene.rig.cameras[strip.camera_index], position_m[frame])
    return figure


def _draw_plan(
    axes: Axes, scene: Scene, position_m: Float[np.ndarray, "frames drones 3"], across: int, up: int
) -> None:
    """Draw the hall, the cameras and the flights, projected along one axis."""
    from matplotlib.patches import Rectangle

    length, width, height = HALLS[scene.scenario.hall].size_m
    lower, upper = np.array([-length / 2, -width / 2, 0.0]), np.array([length / 2, width / 2, height])
    corner, extent = lower[[across, up]], (upper - lower)[[across, up]]
    axes.add_patch(Rectangle(tuple(corner), *extent, facecolor="none", edgecolor="#9aa3ad"))
    for drone, colour in _colours(position_m.shape[1]):
        path = position_m[:, drone]
        axes.plot(path[:, across], path[:, up], color=colour, linewidth=0.8)
        axes.plot(path[0, across], path[0, up], "o", color=colour, markersize=5, label=f"dron{drone + 1}")
    centres = np.array([scene.rig.cameras[i].centre_world for i in range(len(scene.rig.names))])
    axes.plot(centres[:, across], centres[:, up], "^", color="#2b313a", markersize=6)
    for name, at in zip(scene.rig.names, centres, strict=True):
        axes.annotate(name, at[[across, up]], fontsize=7, xytext=(3, 3), textcoords="offset points")
    axes.set(aspect="equal", xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)")
    axes.set_title("from above" if up == 1 else "from the side", fontsize=10)
    if up == 1:
        axes.legend(fontsize=7, ncols=5, loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False)


def _draw_facts(axes: Axes, scene: Scene, position_m: Float[np.ndarray, "frames drones 3"]) -> None:
    """Draw the speed of every drone and the smallest distance between two drones, over time."""
    fps = scene.scenario.fps
    time_s = np.arange(len(position_m)) / fps
    speed = np.linalg.norm(np.diff(position_m, axis=0), axis=-1) * fps
    for drone, colour in _colours(position_m.shape[1]):
        axes.plot(time_s[1:], speed[:, drone], color=colour, linewidth=0.8)
    nearest = _nearest_m(position_m)
    if nearest is not None:
        axes.plot(
            time_s,
            nearest,
            color="black",
            linewidth=1.6,
            label=f"smallest distance (minimum {nearest.min():.2f} m)",
        )
        axes.legend(fontsize=8, loc="upper right")
    mean = f", mean speed {speed.mean():.2f} m/s" if speed.size else ""
    axes.set(xlabel="time (s)", ylabel="speed (m/s), distance (m)", ylim=(0, None))
    axes.set_title(f"{position_m.shape[1]} drones, {len(position_m)} frames{mean}", fontsize=10)


def _nearest_m(position_m: Float[np.ndarray, "frames drones 3"]) -> Float[np.ndarray, "frames"] | None:
    """(frames,), smallest distance between two drones, metres; None for a single drone."""
    first, second = np.triu_indices(position_m.shape[1], 1)
    if not len(first):
        return None
    return np.linalg.norm(position_m[:, first] - position_m[:, second], axis=-1).min(axis=1)


def _mark_drones(axes: Axes, cam: Camera, position_m: Float[np.ndarray, "drones 3"]) -> None:
    pixels, depth_m = project_visible(cam, position_m)
    width, height = (int(side) for side in cam.image_size_wh)
    for drone, colour in _colours(len(position_m)):
        x, y = pixels[drone]
        if depth_m[drone] > 0 and 0 <= x < width and 0 <= y < height:
            axes.plot(x, y, "o", markerfacecolor="none", markeredgecolor=colour, markersize=9, linewidth=0.6)


def _colours(num_drones: int) -> list[tuple[int, str]]:
    """Index and colour of each drone."""
    return [(drone, COLOURS[drone % len(COLOURS)]) for drone in range(num_drones)]

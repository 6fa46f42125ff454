"""Time of localising a camera by markers on walls, in a drawn video or in the video of a sequence.

Runs in one process. To use two cores of a larger machine: `taskset -c 0,1 python localise.py`. Options: `localise.py
--help`.
"""

from __future__ import annotations

import platform
import sys
import tempfile
from pathlib import Path

import click
import cv2
import numpy as np

import psotrack
from psotrack.calibration import lens_of_view
from psotrack.foreground.markers import marker_dictionary
from psotrack.geometry import Camera, look_at, make_camera, project
from psotrack.inside_out import LocalisedVideo, MarkerMap, localise_video, open_source, read_marker_map
from psotrack.inside_out.localising import STAGES
from psotrack.recordings import VideoWriter
from psotrack.recordings.datasets import MARKER_CORNERS, read_onboard

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

_SIZES_WH = {"1920x1080": (1920, 1080), "3840x2160": (3840, 2160)}
_FPS = 25.0
_SIDE_M = 0.3
#: Period of the camera's movement in front of a wall, frames.
_PERIOD_FRAMES = 200
#: Pixels per cell in the picture of a single marker.
_CELL_PX = 24


@click.command(context_settings={"show_default": True})
@click.option(
    "--sequence", type=click.Path(path_type=Path), help="Folder of an _A sequence instead of a drawn video."
)
@click.option("--drone", default="dron1", help="Drone that carries the camera, with --sequence.")
@click.option(
    "--size", default="1920x1080", type=click.Choice(list(_SIZES_WH)), help="Size of the drawn video, pixels."
)
@click.option("--frames", default=250, type=click.IntRange(1), help="Number of frames.")
@click.option("--repeats", default=5, type=click.IntRange(1), help="Number of timed runs.")
@click.option(
    "--results", type=click.Path(path_type=Path), help="Write the result and its record into this folder."
)
def main(
    sequence: Path | None, drone: str, size: str, frames: int, repeats: int, results: Path | None
) -> None:
    """Localise a video; print frames per second, milliseconds per stage, and the machine."""
    started = _results.Run("localise")
    with tempfile.TemporaryDirectory() as folder:
        if sequence is None:
            video, marker_map, lens = (
                Path(folder) / "drawn.avi",
                _wall(),
                lens_of_view(92.45, 60.83, _SIZES_WH[size]),
            )
            _draw(video, marker_map, lens, frames)
        else:
            one = read_onboard(sequence)[drone]
            video, marker_map = one.video.path, read_marker_map(sequence / MARKER_CORNERS)
            lens = make_camera(R=np.eye(3), t_m=np.zeros(3), K=one.K, image_size_wh=one.video.image_size_wh)
        source = open_source(video)
        source = source.first(min(frames, source.num_frames or frames))
        # The first run is not timed, because it compiles, imports and reads the video from the disk.
        runs = [localise_video(source, marker_map, lens) for _ in range(1 + repeats)][1:]
    click.echo(f"{platform.machine()}, {cv2.getNumberOfCPUs()} processors; psotrack {psotrack.__version__}")
    click.echo(
        f"Python {platform.python_version()}, NumPy {np.__version__}, OpenCV {cv2.__version__} "
        f"with {cv2.getNumThreads()} threads"
    )
    _show(runs, source.image_size_wh, len(marker_map))
    if results is not None:
        started.save(results, figures=_figures(runs))


def _figures(runs: list[LocalisedVideo]) -> dict[str, object]:
    """Medians over the runs: frames per second, and milliseconds of each stage per frame."""
    frames = runs[0].path.num_frames
    stages_ms = {
        stage: float(np.median([1e3 * run.seconds[stage] / frames for run in runs])) for stage in STAGES
    }
    per_second = float(np.median([run.frames_per_second for run in runs]))
    return {"frames": frames, "frames_per_second": per_second, "stages_ms": stages_ms}


def _show(runs: list[LocalisedVideo], image_size_wh: tuple[int, int], markers: int) -> None:
    rates = [run.frames_per_second for run in runs]
    path = runs[0].path
    click.echo(
        f"{path.num_frames} frames of {image_size_wh[0]} x {image_size_wh[1]} pixels, {markers} markers in the map, "
        f"median of {np.median(path.num_markers):g} in a frame; a pose in {path.seen.sum()} frames"
    )
    click.echo(
        f"frames per second: median {np.median(rates):.1f} of {len(runs)} runs, {min(rates):.1f} to {max(rates):.1f}"
    )
    for stage in STAGES:
        each_ms = [1e3 * run.seconds[stage] / path.num_frames for run in runs]
        click.echo(f"{stage:<8} {np.median(each_ms):6.2f} ms per frame")


def _wall() -> MarkerMap:
    """Map of 28 markers on a wall at y = 4 m, in rows."""
    corners = {}
    for index in range(28):
        x, z = -3.5 + index % 7, 0.4 + 0.7 * (index // 7)
        corners[index + 1] = np.array(
            [[x, 4, z + _SIDE_M], [x + _SIDE_M, 4, z + _SIDE_M], [x + _SIDE_M, 4, z], [x, 4, z]]
        )
    return MarkerMap(corners)


def _draw(path: Path, marker_map: MarkerMap, lens: Camera, frames: int) -> None:
    """Draw a video of a camera in front of the wall, which has a texture and coloured boards."""
    size_wh = (int(lens.image_size_wh[0]), int(lens.image_size_wh[1]))
    background = cv2.resize(_background(), size_wh, interpolation=cv2.INTER_LINEAR)
    with VideoWriter(path, _FPS, size_wh) as writer:
        for frame in range(frames):
            angle = 2 * np.pi * frame / _PERIOD_FRAMES
            R, t_m = look_at(
                (1.5 * np.sin(angle), 0.8 * np.cos(angle), 1.5), (0.8 * np.sin(2 * angle), 4.0, 1.5)
            )
            posed = make_camera(R=R, t_m=t_m, K=lens.K, image_size_wh=size_wh)
            image = background.copy()
            for marker, corners_m in marker_map.corners_m.items():
                _add_marker(image, marker, project(posed, corners_m)[0])
            writer.write(image)


def _background() -> np.ndarray:
    """The wall without markers, 1920 x 1080."""
    size_wh, rng = (1920, 1080), np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.normal(0, 60, size_wh[::-1]), (0, 0), 4)
    background = np.repeat((170 + texture)[..., None], 3, axis=-1)
    for _ in range(20):
        x, y = rng.uniform((0, 0), size_wh).astype(int)
        width, height = rng.integers(60, 300, 2)
        background[y : y + height, x : x + width] = rng.uniform(40, 220, 3)
    return np.clip(background, 0, 255).astype(np.uint8)


def _add_marker(image: np.ndarray, marker: int, corners_px: np.ndarray) -> None:
    """Draw one marker, with a border of one white cell, in the part of the image that contains it."""
    low = np.maximum(np.floor(1.3 * corners_px.min(axis=0) - 0.3 * corners_px.max(axis=0)), 0).astype(int)
    high = np.ceil(1.3 * corners_px.max(axis=0) - 0.3 * corners_px.min(axis=0)).astype(int)
    high = np.minimum(high, image.shape[1::-1])
    if (high <= low).any():
        return
    own = cv2.copyMakeBorder(
        cv2.aruco.generateImageMarker(marker_dictionary("4x4_1000"), marker, 6 * _CELL_PX),
        *[_CELL_PX] * 4,
        cv2.BORDER_CONSTANT,
        value=255,
    )
    near, far = _CELL_PX - 0.5, 7 * _CELL_PX - 0.5
    at = np.array([[near, near], [far, near], [far, far], [near, far]], np.float32)
    towards = cv2.getPerspectiveTransform(at, (corners_px - low).astype(np.float32))
    size = tuple(int(side) for side in high - low)
    warped = cv2.warpPerspective(own, towards, size, flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.full_like(own, 255), towards, size, flags=cv2.INTER_NEAREST) > 0
    image[low[1] : high[1], low[0] : high[0]][inside] = (30 + (190 / 255) * warped[inside])[:, None]


if __name__ == "__main__":
    main()

"""Inputs of `onboard map`: the corners of known markers, and videos with their lenses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

from psotrack import geometry, inside_out, recordings, support
from psotrack.errors import InputError, SettingsError
from psotrack.recordings import datasets

if TYPE_CHECKING:
    import numpy as np


#: Rate of pictures where none is given. A map does not depend on the rate, only the time from row to row does.
PICTURES_FPS = 25.0


def known_corners(
    known: str | None, table: Path | None, side_m: float | None, sources: tuple[Path, ...]
) -> dict[int, np.ndarray]:
    """Corners of the known markers, (4, 3) in metres, by id."""
    words = [word.strip() for word in (known or "").split(",") if word.strip()]
    numbers = [support.whole_number(word) for word in words]
    ids = list(dict.fromkeys(number for number in numbers if number is not None))
    if not numbers or None in numbers:
        expected = "numbers of markers that are known, such as 7 or 7,12"
        raise SettingsError("--known", expected=expected, found=known or "none")
    if table is None and side_m is None and datasets.is_recording(sources[0]):
        table = datasets.find_marker_corners(sources[0])
    if table is not None:
        marker_map = inside_out.read_marker_map(table)
        missing = [marker for marker in ids if marker not in marker_map]
        if missing:
            found = f"only {', '.join(map(str, marker_map.ids.tolist()))}"
            raise InputError(table, expected=f"the known marker {missing[0]}", found=found)
        return {marker: marker_map.corners_m[marker] for marker in ids}
    if side_m is None or len(ids) > 1:
        expected = "--markers with the corners of the known markers, or --side and one known marker"
        raise SettingsError(
            "--known", expected=expected, found="no --markers" if side_m is not None else "neither"
        )
    return {ids[0]: inside_out.corners_in_own_frame(side_m)}


@dataclass(frozen=True)
class OnboardLensOptions:
    """Options that give the lenses of the videos.

    Attributes:
        file: intrinsics of the cameras: .csv, .toml or .yml; None: the sequence's.
        names: names of the cameras in the file, if it has several: one for all videos, or one for each video.
        scale: scale the intrinsics to the size of the images; both must show the same field of view.
        fov_deg: horizontal and vertical field of view in degrees, instead of intrinsics.
    """

    file: Path | None = None
    names: tuple[str, ...] | None = None
    scale: bool = False
    fov_deg: Annotated[tuple[float, float], Meta(extra={"metavar": "H,V"})] | None = None

    def of(
        self, size_wh: tuple[int, int], index: int = 0, count: int = 1, K: np.ndarray | None = None
    ) -> geometry.Camera:
        """Lens of video number `index` of `count` videos, whose images have `size_wh` pixels; K is the sequence's."""
        if K is not None and self.file is None and self.fov_deg is None:
            return inside_out.lens_from_matrix(K, size_wh)
        names: tuple[str | None, ...] = self.names or (None,)
        if len(names) not in (1, count):
            expected = f"one name, or one for each of {count} videos"
            raise SettingsError("--camera-name", expected=expected, found=f"{len(names)}")
        name = names[index % len(names)]
        return inside_out.choose_lens(
            size_wh, path=self.file, fov_deg=self.fov_deg, name=name, scale=self.scale
        )


#: Names of the options of `Lenses`.
LENS_NAMES = {"file": "camera", "names": "camera-name", "scale": "scale-camera"}


def videos_of(
    sources: tuple[Path, ...],
    drones: tuple[str, ...] | None,
    lenses: OnboardLensOptions,
    fps: float | None = None,
) -> dict[str, tuple[recordings.VideoInfo, geometry.Camera]]:
    """Videos with their lenses, by name; a folder of pictures is a video of `fps` frames per second."""
    if datasets.is_recording(sources[0]):
        if len(sources) > 1:
            raise SettingsError("SOURCE", expected="one sequence, or videos", found=f"{len(sources)} sources")
        onboard = onboard_videos(sources[0], drones)
        return {
            name: (one.video, lenses.of(one.video.image_size_wh, index, len(onboard), one.K))
            for index, (name, one) in enumerate(onboard.items())
        }
    if drones is not None:
        raise SettingsError("--drone", expected="a sequence's folder as SOURCE", found=f"{sources[0]}")
    rates = [fps or (PICTURES_FPS if recordings.is_picture_folder(path) else None) for path in sources]
    infos = [recordings.open_video(path, rate) for path, rate in zip(sources, rates, strict=True)]
    return {
        str(video.path): (video, lenses.of(video.image_size_wh, index, len(infos)))
        for index, video in enumerate(infos)
    }


def onboard_videos(folder: Path, names: tuple[str, ...] | None) -> dict[str, recordings.OnboardVideo]:
    """Videos of the cameras on a sequence's drones, by name: all of them, or those of some names."""
    onboard = datasets.read_onboard(folder)
    if not onboard:
        raise InputError(
            folder, expected="videos of drones' own cameras, such as dron1_cam_s.avi", found="none"
        )
    unknown = [name for name in names or () if name not in onboard]
    if unknown:
        raise SettingsError("--drone", expected=f"names among {', '.join(onboard)}", found=", ".join(unknown))
    return {name: onboard[name] for name in names or onboard}


def leading(video: recordings.VideoInfo, num_frames: int | None) -> recordings.VideoInfo:
    """A video cut to its first `num_frames` frames; None keeps all frames."""
    if num_frames is None:
        return video
    if not 0 < num_frames <= video.num_frames:
        expected = f"1 to {video.num_frames}, the frames of {video.path}"
        raise SettingsError("--frames", expected=expected, found=f"{num_frames}")
    return replace(video, num_frames=num_frames)

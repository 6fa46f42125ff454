"""Images of several cameras, which of them belong to one instant, and the pixels of a board's corners in all of them.

A camera's images are a video, or image files that have numbers in their names. Frames of equal number are one instant;
of names that are times, such as nanoseconds, the nearest ones.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, zip_longest
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.calibration.board_recognition import (
    BoardFinder,
    measure_markers,
    missing_board,
    recognise_board,
)
from psotrack.calibration.boards import LEAST_CORNERS, Board
from psotrack.errors import InputError, SettingsError
from psotrack.recordings import (
    IMAGE_SUFFIXES,
    Recording,
    VideoInfo,
    image_files,
    make_timeline,
    probe,
    probe_images,
    read_frames_at,
)
from psotrack.support import Report, evenly_spread, no_progress

_PATTERN = re.compile(r"[*?\[]")
#: Largest number of instants in which the board is searched; limits the time for long videos.
MOST_INSTANTS = 300
#: Seconds since 1970, or since the start, with decimals, at the end of an image's name, as TUM's recordings have.
_SECONDS = re.compile(r"(\d{9,})\.(\d+)$")
#: Smallest number in the names of images that is a time: no camera counts as many frames.
_LEAST_TIME = 10**11
#: Number of each instant, (instants,), and each camera's frame, (instants, cameras), -1 where it has none.
Instants = tuple[Int[np.ndarray, " instants"], Int[np.ndarray, "instants cameras"]]
#: Largest relative difference of the frame rates of videos whose frames are counted alike.
_SAME_RATE = 0.005
#: Largest number of images of each camera from which the print is found out.
_MOST_SAMPLES = 24
#: Largest deviation of the measured size of a ChArUco board's markers from the stated one: corners of markers of 10
#: pixels, the smallest that are read, are found to about half a pixel at each end.
_MARKER_SIZE_ERROR = 0.2


@dataclass(frozen=True)
class CameraImages:
    """Images of one camera.

    Attributes:
        name: name of the camera.
        path: the video, the folder or the pattern.
        video: the video, or the images as one.
        frames: (frames,), numbers of the frames, increasing.
    """

    name: str
    path: Path
    video: VideoInfo
    frames: Int[np.ndarray, " frames"]

    @property
    def image_size_wh(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.video.image_size_wh

    def read(
        self, chosen: Int[np.ndarray, " chosen"]
    ) -> Iterator[tuple[int, UInt8[np.ndarray, "height width"]]]:
        """Yield the numbers and grey images of the chosen frames, in increasing order.

        Raises:
            InputError: an image cannot be read, or has another size than the first one.
        """
        rows = np.flatnonzero(np.isin(self.frames, chosen)).tolist()
        for row, image in read_frames_at(self.video, rows):
            yield int(self.frames[row]), cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def open_images(paths: Sequence[Path | str], names: Sequence[str] | None = None) -> tuple[CameraImages, ...]:
    """Open the images of each camera: videos, folders of images, or patterns such as left*.png.

    Args:
        paths: one path or pattern for each camera.
        names: names of the cameras; None to take them from the paths.

    Raises:
        InputError: a path cannot be read, images have no or equal numbers, a camera is given twice, or two videos have
            different frame rates.
        SettingsError: there are not as many names as paths.
    """
    found = [Path(path) for path in paths]
    if names is None:
        names = _names(found)
    if len(names) != len(found):
        raise SettingsError("names", expected=f"{len(found)} names", found=f"{len(names)}")
    real = [path.resolve() for path in found]
    for index, (name, path) in enumerate(zip(names, real, strict=True)):
        if path in real[:index] or name in names[:index]:
            raise InputError(found[index], expected="each camera once", found=f"{name} again")
    cameras = tuple(_open(name, path) for name, path in zip(names, found, strict=True))
    rates = {camera.name: camera.video.fps for camera in cameras if not camera.video.images}
    for name, fps in rates.items():
        first = next(iter(rates))
        if abs(fps - rates[first]) > _SAME_RATE * rates[first]:
            raise InputError(
                f"camera {name}",
                expected=f"{rates[first]:g} frames per second as of {first}",
                found=f"{fps:g}",
                remedy="write a recording.toml that says when the frames were exposed, and pass it",
            )
    return cameras


def open_recorded(recording: Recording) -> tuple[tuple[CameraImages, ...], Instants]:
    """Images of a recording's cameras, and which of their frames belong to one instant of its clock.

    Returns:
        the images; and the number of each instant, (instants,), with each camera's frame, (instants, cameras), -1 where
        it has none.

    Raises:
        InputError: no camera has a video.
    """
    if not recording.videos:
        raise InputError(recording.folder, expected="videos or images of a board", found="none")
    cameras = tuple(
        CameraImages(name, video.path, video, np.arange(video.num_frames))
        for name, video in recording.videos.items()
    )
    # Not the timeline of the recording, which has only the cameras that are placed.
    timeline = make_timeline(
        {each.name: each.times for each in recording.cameras if each.video and each.times},
        recording.timing.rate_hz,
    )
    return cameras, (np.arange(timeline.num_instants), timeline.frame.astype(np.int64))


def instants_of_numbers(cameras: Sequence[CameraImages]) -> Instants:
    """Instants of frames of equal number; of frames that are named by times, those that are nearest to each other."""
    if min(int(camera.frames[-1]) for camera in cameras) >= _LEAST_TIME:
        return _nearest_in_time(cameras)
    numbers = np.unique(np.concatenate([camera.frames for camera in cameras]))
    frames = np.stack([np.where(np.isin(numbers, camera.frames), numbers, -1) for camera in cameras], axis=1)
    return numbers, frames


def _nearest_in_time(cameras: Sequence[CameraImages]) -> Instants:
    """Frames of several cameras are one instant if they are within half an interval of the fastest camera."""
    intervals = [np.median(np.diff(camera.frames)) for camera in cameras if len(camera.frames) > 1]
    apart = min(intervals, default=0.0) / 2
    instants: list[dict[int, int]] = []
    for time, index in sorted((int(time), k) for k, camera in enumerate(cameras) for time in camera.frames):
        if not instants or index in instants[-1] or time - min(instants[-1].values()) > apart:
            instants.append({})
        instants[-1][index] = time
    frames = np.array([[each.get(index, -1) for index in range(len(cameras))] for each in instants])
    return np.array([min(each.values()) for each in instants]), frames


def choose_instants(instants: Instants, floor: int | None = None, shifts: Sequence[int] = ()) -> Instants:
    """The instants in which the board is searched: at most `MOST_INSTANTS`, evenly spread.

    Args:
        instants: all of them.
        floor: number of an instant that is not left out; None for no such instant.
        shifts: for each camera, at how many instants later it shows what the others show; none for 0.
    """
    number, frames = instants
    # Multiples of a step are read without decoding all frames between them.
    chosen = np.arange(len(number)) % max(1, -(-len(number) // MOST_INSTANTS)) == 0
    chosen |= number == floor
    frames = frames.copy()
    for camera, shift in enumerate(shifts):
        row = np.searchsorted(number, number + shift).clip(max=len(number) - 1)
        frames[:, camera] = np.where(number[row] == number + shift, frames[row, camera], -1)
    return number[chosen], frames[chosen]


def _names(paths: list[Path]) -> list[str]:
    """Names of the cameras: the first part, from the end of the paths, in which all paths differ."""
    if len(paths) == 1:
        return [_stem(paths[0].name, paths[0])]
    parts = [path.absolute().parts for path in paths]
    for depth in range(1, min(map(len, parts)) + 1):
        words = [_stem(part[-depth], path) for part, path in zip(parts, paths, strict=True)]
        if len(set(words)) == len(words):
            return words
        if len(set(words)) > 1:
            break
    return [_stem(path.name, path) for path in paths]


def _is_pattern(path: Path) -> bool:
    """Whether a path stands for several files; a folder may be called cam[1]."""
    return bool(_PATTERN.search(path.name)) and not path.exists()


def _stem(word: str, path: Path) -> str:
    """A part of a path without its suffix, and without the wildcards of a pattern."""
    stem = word if not Path(word).suffix else Path(word).stem
    return (_PATTERN.split(stem)[0].rstrip("_-. ") or stem) if _is_pattern(path) else stem


def _open(name: str, path: Path) -> CameraImages:
    if _is_pattern(path):
        files = sorted(file for file in path.parent.glob(path.name) if file.suffix.lower() in IMAGE_SUFFIXES)
        if not files:
            raise InputError(path, expected="images of this pattern", found="none")
    elif path.is_dir():
        files = image_files(path)
        if not files:
            raise InputError(path, expected="a folder with videos or images", found="neither in it")
    else:
        video = probe(path)
        return CameraImages(name, path, video, np.arange(video.num_frames))
    numbered: dict[int, Path] = {}
    for file in files:
        seconds, digits = _SECONDS.search(file.stem), re.findall(r"\d+", file.stem)
        if not digits:
            raise InputError(file, expected="a name with the number of the frame", found="no number")
        number = int(digits[-1]) if seconds is None else int(f"{seconds[1]}{seconds[2]:0<9.9}")
        if number in numbered:
            raise InputError(
                file, expected="each number once", found=f"{number} as of {numbered[number].name}"
            )
        numbered[number] = file
    ordered = dict(sorted(numbered.items()))
    return CameraImages(name, path, probe_images(list(ordered.values()), 1.0), np.array(list(ordered)))


def first_images(cameras: Sequence[CameraImages], count: int) -> list[UInt8[np.ndarray, "_ _"]]:
    """About `count` grey images of each camera, evenly spread over the recording, of the cameras in turn."""
    steps = (max(1, len(camera.frames) // count) for camera in cameras)
    return list(_in_turn(cameras, [each.frames[::step] for each, step in zip(cameras, steps, strict=True)]))


@dataclass(frozen=True)
class BoardViews:
    """Pixels of a board's corners.

    Attributes:
        names: names of the cameras.
        image_size_wh: (cameras, 2), width and height of the images, pixels.
        number: (instants,), number of each instant: that of the frames, where frames of equal number are one instant.
        corners_px: (cameras, instants, corners, 2), pixels; NaN where a corner is not seen.
    """

    names: tuple[str, ...]
    image_size_wh: Int[np.ndarray, "cameras 2"]
    number: Int[np.ndarray, " instants"]
    corners_px: Float[np.ndarray, "cameras instants corners 2"]

    @property
    def seen(self) -> Bool[np.ndarray, "cameras instants"]:
        """(cameras, instants), True where a camera sees enough corners."""
        least = min(LEAST_CORNERS, self.corners_px.shape[2])
        return np.isfinite(self.corners_px[..., 0]).sum(axis=-1) >= least

    def select(self, instants: Bool[np.ndarray, " instants"]) -> BoardViews:
        """Views of chosen instants."""
        return replace(self, number=self.number[instants], corners_px=self.corners_px[:, instants])


@dataclass(frozen=True)
class FoundBoards:
    """Views of a board, and how they were found.

    Attributes:
        views: the views; instants at which no camera sees the board are left out.
        board: the board, with the pattern that was found.
        mirrored: (cameras,), number of views in which the board is seen mirrored.
        searched: (cameras,), number of images that were searched.
        frames: (cameras,), number of all images.
    """

    views: BoardViews
    board: Board
    mirrored: Int[np.ndarray, " cameras"]
    searched: Int[np.ndarray, " cameras"]
    frames: Int[np.ndarray, " cameras"]


def find_views(
    board: Board,
    cameras: Sequence[CameraImages],
    instants: tuple[Int[np.ndarray, " instants"], Int[np.ndarray, "instants cameras"]],
    report: Report = no_progress,
) -> FoundBoards:
    """Find the corners of a board in the images of all cameras.

    Args:
        board: the board; how it was printed is found out.
        cameras: the images.
        instants: number of each instant, and (instants, cameras), number of each camera's frame or -1.
        report: display of the progress.

    Raises:
        InputError: an image cannot be read, or a camera never sees the board; the message says what is seen instead.
    """
    number, frames = instants
    board, seen_times = recognise_board(board, _samples(cameras, frames))
    if not seen_times:
        raise missing_board(board, list(islice(_samples(cameras, frames), _MOST_SAMPLES)))
    _check_markers(board, _samples(cameras, frames))
    finder = BoardFinder(board)
    corners_px = np.full((len(cameras), len(number), board.num_corners, 2), np.nan)
    mirrored = np.zeros(len(cameras), np.int64)
    with report("corners", int((frames >= 0).sum())) as advance:
        for index, camera in enumerate(cameras):
            row_of = {int(frame): row for row, frame in enumerate(frames[:, index]) if frame >= 0}
            for frame, grey in camera.read(np.array(sorted(row_of), np.int64)):
                advance(1)
                row = row_of[frame]
                corners_px[index, row] = finder.find(grey)
                if np.isnan(corners_px[index, row, :, 0]).all() and board.kind != "chessboard":
                    corners_px[index, row] = finder.find_mirrored(grey)
                    mirrored[index] += bool(np.isfinite(corners_px[index, row, :, 0]).any())
    views = BoardViews(
        tuple(camera.name for camera in cameras),
        np.array([camera.image_size_wh for camera in cameras]),
        number,
        corners_px,
    )
    searched = (frames >= 0).sum(axis=0)
    for name, of_camera, count in zip(views.names, views.seen, searched.tolist(), strict=True):
        if not of_camera.any():
            raise InputError(
                f"camera {name}",
                expected="views of the board that the other cameras see",
                found=f"none in {count} frames",
                remedy="check that the board is in its images, sharp and large enough, or leave the camera out",
            )
    every = np.array([len(camera.frames) for camera in cameras])
    return FoundBoards(views.select(np.asarray(views.seen.any(axis=0))), board, mirrored, searched, every)


def _check_markers(board: Board, images: Iterator[UInt8[np.ndarray, "height width"]]) -> None:
    """Raise `InputError` for a board whose markers are of another size than stated."""
    measured = measure_markers(board, images)
    if measured is None or board.marker_m is None:
        return
    stated = board.marker_m / board.square_m
    if abs(measured / stated - 1) > _MARKER_SIZE_ERROR:
        raise InputError(
            "board",
            expected=f"markers with sides of {stated:.2f} squares, as --square and --marker say",
            found=f"{measured:.2f} squares in the images",
            remedy="measure both with a ruler",
        )


def _samples(
    cameras: Sequence[CameraImages], frames: Int[np.ndarray, "instants cameras"]
) -> Iterator[UInt8[np.ndarray, "height width"]]:
    """Grey images of all cameras in turn, evenly spread over the recording."""
    there = [of_camera[of_camera >= 0] for of_camera in frames.T]
    # A round visits the recording from one end to the other, so that the first images differ.
    return _in_turn(cameras, [one[evenly_spread(len(one), _MOST_SAMPLES)] for one in there])


def _in_turn(
    cameras: Sequence[CameraImages], chosen: Sequence[Int[np.ndarray, " chosen"]]
) -> Iterator[UInt8[np.ndarray, "height width"]]:
    """Grey images of chosen frames of each camera, of the cameras in turn."""
    readers = [camera.read(frames) for camera, frames in zip(cameras, chosen, strict=True)]
    return (one[1] for of_all in zip_longest(*readers) for one in of_all if one is not None)

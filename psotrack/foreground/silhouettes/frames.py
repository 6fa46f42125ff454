"""Silhouettes of all cameras, read in pieces, by frames or by instants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import zarr
from jaxtyping import Int, UInt8

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes.exposures import Exposures
from psotrack.foreground.silhouettes.usable_frames import Interval
from psotrack.recordings import Timeline
from psotrack.support import short_repr


@dataclass(frozen=True, repr=False)
class Silhouettes:
    """Stored silhouettes of all cameras of a sequence.

    Attributes:
        cameras: names of the cameras, in the order of the rig.
        keys: key of each camera's silhouettes, by camera name; a camera without silhouettes has none.
        reduction: r; cell (i, j) covers the pixels [r * i, r * i + r) x [r * j, r * j + r). Pixels beyond the image's
            border count as background.
        num_frames: number of frames of the longest camera.
        shape: height and width of the largest silhouette, cells.
        seconds: time spent on "decode" and "foreground", summed over workers, and time until all "silhouettes" were
            made; 0 for silhouettes from the store.
        arrays: one array (frames, height, width) per camera, stored or in memory; cameras may differ in frames, height
            and width. A camera without silhouettes has no frames.
        exposures: when the frames were exposed; None where frame i of every camera is instant i.
        left_out: frames of a camera's video in which foreground is everywhere, which repeat the picture before, or
            which do not show the scene, as intervals (first frame, frame after the last), by camera name; these frames
            show no foreground in `arrays`, and `at_instants` says that the camera sees nothing.
    """

    cameras: tuple[str, ...]
    keys: Mapping[str, str]
    reduction: int
    num_frames: int
    shape: tuple[int, int]
    seconds: Mapping[str, float]
    arrays: tuple[zarr.Array | FramesOfInstants | UInt8[np.ndarray, "frames height width"], ...]
    exposures: Exposures | None = None
    left_out: Mapping[str, list[Interval]] = field(default_factory=dict)

    __repr__ = short_repr

    @property
    def borders(self) -> Int[np.ndarray, "cameras 2"]:
        """(cameras, 2), width and height of each camera's silhouettes, cells."""
        return np.array([array.shape[:0:-1] for array in self.arrays], int)

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "frames cameras height width"]:
        """Read the coverage of the frames [start, stop), 0 to 255: (frames, cameras, height, width).

        Smaller silhouettes, and those of a camera that has fewer frames, are filled up with 0.

        Raises:
            SettingsError: the frames do not exist.
        """
        if not 0 <= start <= stop <= self.num_frames:
            raise SettingsError(
                "frames", expected=f"a part of 0 to {self.num_frames}", found=f"{start} to {stop}"
            )
        frames = np.zeros((stop - start, len(self.cameras), *self.shape), np.uint8)
        for index, array in enumerate(self.arrays):
            read = np.asarray(array[start:stop])
            count, height, width = read.shape
            frames[:count, index, :height, :width] = read
        return frames

    def part(self, start: int, stop: int) -> Silhouettes:
        """The instants [start, stop) of silhouettes at instants, in memory; errors as of `read`."""
        arrays = tuple(self.read(start, stop).swapaxes(0, 1))
        exposures = None if self.exposures is None else self.exposures[start:stop]
        return replace(self, num_frames=stop - start, arrays=arrays, exposures=exposures)

    def at_instants(self, timeline: Timeline) -> Silhouettes:
        """These silhouettes with instants instead of frames: each camera shows its frame nearest to the instant.

        A camera without a frame at an instant, or without video, shows no foreground, and `exposures` says so. Where
        frame i of every camera is instant i, the silhouettes stay as they are.

        Raises:
            SettingsError: the timeline is of other cameras.
        """
        if timeline.cameras != self.cameras:
            raise SettingsError(
                "timeline", expected=f"cameras {self.cameras}", found=f"cameras {timeline.cameras}"
            )
        assert self.exposures is None, "instants of instants have no meaning"
        shown = [_shown(array, frame) for array, frame in zip(self.arrays, timeline.frame.T, strict=True)]
        frame = np.stack([each.frame for each in shown], axis=1)
        if timeline.is_synchronous and timeline.num_instants == self.num_frames and (frame >= 0).all():
            return self
        offset_s = np.where(frame < 0, 0.0, timeline.offset_s)
        exposures = exposures_of(replace(timeline, frame=frame, offset_s=offset_s))
        return replace(self, num_frames=timeline.num_instants, arrays=tuple(shown), exposures=exposures)


def exposures_of(timeline: Timeline) -> Exposures:
    """When the frames that a timeline's instants show were exposed, in float32."""
    of_cameras = np.zeros(len(timeline.cameras)) if timeline.line_time_s is None else timeline.line_time_s
    line_time_s = np.broadcast_to(of_cameras, timeline.frame.shape).astype(np.float32)
    offset_s, share = (value.astype(np.float32) for value in (timeline.offset_s, timeline.share))
    return Exposures(offset_s, timeline.is_there, share, line_time_s)


@dataclass(frozen=True)
class FramesOfInstants:
    """The frames of one camera by instants instead of their numbers.

    Attributes:
        array: the camera's frames.
        frame: (instants,), number of the frame of each instant; -1 for none, which reads as 0.
    """

    array: zarr.Array | UInt8[np.ndarray, "frames height width"]
    frame: Int[np.ndarray, "instants"]

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of instants, rows and columns."""
        return (len(self.frame), *self.array.shape[1:])

    def __getitem__(self, instants: slice) -> UInt8[np.ndarray, "instants height width"]:
        frame = self.frame[instants]
        frames = np.zeros((len(frame), *self.array.shape[1:]), np.uint8)
        there = frame >= 0
        if there.any():
            first, last = int(frame[there].min()), int(frame[there].max())
            frames[there] = np.asarray(self.array[first : last + 1])[frame[there] - first]
        return frames


def _shown(
    array: zarr.Array | FramesOfInstants | UInt8[np.ndarray, "frames height width"],
    frame: Int[np.ndarray, "instants"],
) -> FramesOfInstants:
    """The frames of a camera by instants; those that the camera does not show, or does not have, are none."""
    frames = (
        array if isinstance(array, FramesOfInstants) else FramesOfInstants(array, np.arange(array.shape[0]))
    )
    numbers = np.append(frames.frame, -1)
    return FramesOfInstants(frames.array, numbers[np.where(frame < len(frames.frame), frame, -1)])

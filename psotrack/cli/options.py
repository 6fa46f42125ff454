"""Arguments and options that several commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click
from msgspec import Meta

from psotrack import recordings
from psotrack.cli.output import Output
from psotrack.cli.types import RUNNING, SequencePath, archive_of, says
from psotrack.errors import InputError, SettingsError
from psotrack.recordings import datasets
from psotrack.settings import BLOBS, YOLO
from psotrack.show import flights
from psotrack.support import user_cache

#: Side of a detector network's square input, pixels: the size that YOLO networks are trained with.
DETECTOR_SIZE = 640

Seq = Annotated[Path, says(metavar="SEQ", type=SequencePath(path_type=Path))]
#: A command does without it where the record of the tracks names the recording.
SeqOfTracks = Annotated[Path | None, says(metavar="[SEQ]", type=SequencePath(path_type=Path))]
Cache = Annotated[
    Path | None,
    says(
        words="folder of silhouettes and compiled programs. None: $PSOTRACK_CACHE, or psotrack in your cache folder.",
        envvar="PSOTRACK_CACHE",
        heading=RUNNING,
    ),
]
Jobs = Annotated[
    Annotated[int, Meta(ge=1)] | None,
    says(words="largest number of processes. None: one per processor.", heading=RUNNING),
]
Cameras = Annotated[
    tuple[str, ...] | None, says(words="use these cameras only. None: all cameras of the calibration.")
]
NumFrames = Annotated[
    int | None, says(flag="frames", metavar="N", words="use the first N frames only. None: all.")
]
MostDrones = Annotated[Annotated[int, Meta(ge=1, le=1000)], says(rare=True)]
Dictionary = Annotated[str, says(words="dictionary of the markers; any dictionary of OpenCV.")]


def _read_bodies(_: click.Context, __: click.Parameter, given: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    bodies = {}
    for each in given:
        name, equals, labels = (part.strip() for part in each.partition("="))
        chosen = (
            tuple(label.strip() for label in labels.split(",") if label.strip()) if equals else (f"{name}:",)
        )
        if not name or not chosen:
            raise SettingsError("--body", expected="NAME=LABEL,LABEL,... or NAME", found=each)
        if name in bodies:
            raise SettingsError("--body", expected="each drone once", found=f"{name} twice")
        bodies[name] = chosen
    return bodies


Bodies = Annotated[
    dict[str, tuple[str, ...]],
    says(
        words="markers of drone NAME in the C3D file of the reference; `cf1:` stands for all markers of the body cf1, "
        "and NAME alone for those of the body NAME; may be repeated. None: bodies called dron..., or rigid ones.",
        flag="body",
        metavar="NAME=LABEL,...",
        multiple=True,
        required=False,
        callback=_read_bodies,
    ),
]


def _check_picture(_: click.Context, __: click.Parameter, path: Path | None) -> Path | None:
    if path is not None and path.name and path.suffix.lower() != ".png":
        raise SettingsError("--plot", expected="a file that ends in .png", found=path.name)
    return path


#: `--plot [PNG]`: a picture, at a default place if no path follows; the value is then empty.
Plot = Annotated[Path | None, says(is_flag=False, flag_value="", metavar="[PNG]", callback=_check_picture)]


@dataclass(frozen=True)
class Extent:
    """What of a recording is used, and by what.

    Attributes:
        cameras: names of the cameras; None are all.
        num_frames: number of frames from the first one; None are all.
        cache: folder of silhouettes and compiled programs; None is the usual one.
        jobs: largest number of processes; None is one per processor.
    """

    cameras: Cameras = None
    num_frames: NumFrames = None
    cache: Cache = None
    jobs: Jobs = None

    @property
    def silhouettes(self) -> Path:
        """Folder of the stored silhouettes."""
        return cache_folder(self.cache)


def filmed_recording(source: Path, extent: Extent) -> recordings.Recording:
    """The videos of a recording, calibrated or not, or a single video, or a folder of pictures as a recording."""
    if not source.exists():
        raise InputError(
            source, expected="a video, a folder of pictures, or a recording", found="no such file or folder"
        )
    if not datasets.is_recording(source) and (source.is_file() or recordings.is_picture_folder(source)):
        # Nothing that is made from the pictures depends on their rate.
        recording = recordings.recording_of_video(
            recordings.open_video(source, 1.0 if recordings.is_picture_folder(source) else None)
        )
    else:
        recording = recordings.with_all_videos(datasets.open_recording(source))
    return recording.usable(extent.cameras, extent.num_frames)


def cache_folder(chosen: str | Path | None) -> Path:
    """Folder of the stored silhouettes: `chosen`, or the user's."""
    return Path(chosen) if chosen else user_cache()


def compiled_folder(chosen: str | Path | None) -> Path:
    """Folder of compiled programs, inside the folder of the silhouettes."""
    return cache_folder(chosen) / "compiled"


def beside(sequence: Path, name: str) -> Path:
    """Default of `--out`: `name` in the folder `results` of a recording, or beside an archive."""
    archive = archive_of()
    if archive is not None:
        return archive.path.with_suffix("") / name
    return (sequence if sequence.is_dir() else sequence.parent) / "results" / name


def detections_of(output: Output, recording: recordings.Recording) -> str:
    """Default of `--detections`: the recording's own, or the blobs of its silhouettes where there are none."""
    if recording.detections:
        return YOLO
    output.say(f"{recording.name} has no detections: the blobs of its silhouettes take their place")
    return BLOBS


def sequence_of(tracks: Path, given: Path | None) -> Path:
    """The recording of tracks: the one that the user names, or the one that their record names.

    Raises:
        InputError: no record beside the tracks names a recording that is there.
    """
    found = given or flights.find_recording(tracks)
    if found is None:
        raise InputError(
            tracks,
            expected="a record beside the tracks that names their recording",
            found="none",
            remedy="name SEQ",
        )
    return found


def recording_named(sequence: Path, tracks: Path) -> str:
    """How the record beside tracks names their recording; empty for an archive, whose content is gone afterwards."""
    return "" if archive_of() is not None else flights.recording_beside(sequence, tracks)

"""Arguments and options that several commands share."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.log_file import LogFile
from psotrack.cli.output import PROGRESS, Output, current_output, pass_output
from psotrack.cli.records import Command, Option
from psotrack.cli.types import Names, SequencePath
from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.settings import BLOBS, YOLO
from psotrack.support import refuse_files, user_cache

if TYPE_CHECKING:
    from psotrack.recordings import Recording

#: Side of a detector network's square input, pixels: the size that YOLO networks are trained with.
DETECTOR_SIZE = 640
#: Heading of the options that are not about the work itself.
RUNNING = "Running"

TRACKS = click.argument("tracks", type=click.Path(path_type=Path))
SEQUENCE = click.argument("sequence", metavar="SEQ", type=SequencePath(path_type=Path))


def sequence_argument(command: Command) -> Command:
    """Add [SEQ], which a command does without where the record of the tracks names the recording."""
    return click.argument("sequence", metavar="[SEQ]", type=SequencePath(path_type=Path), required=False)(
        command
    )


def _flag(name: str, words: str, *more: str) -> Callable[[Command], Command]:
    """A flag that sets an attribute of the command's `Output`."""

    def choose(_: click.Context, __: click.Parameter, value: bool) -> None:
        setattr(current_output(), name, value)

    return click.option(
        f"--{name}",
        *more,
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=choose,
        cls=Option,
        heading=RUNNING,
        help=words,
    )


FORCE = _flag("force", "Replace existing files.")
QUIET = _flag("quiet", "Print no progress and no results, only errors.", "-q")


def _take_progress(_: click.Context, __: click.Parameter, chosen: str) -> None:
    current_output().progress = chosen


def _open_log(context: click.Context, _: click.Parameter, path: Path | None) -> None:
    if path is not None and not context.resilient_parsing:
        # The outermost context ends after everything that the command says, its errors included.
        context.find_root().with_resource(LogFile(path))


def _take_json(context: click.Context, _: click.Parameter, path: Path | None) -> None:
    """A file that cannot be written, or must not be replaced, is refused before the work."""
    # /dev/stdout is stdout, which then gets nothing but the JSON.
    path = Path("-") if path == Path("/dev/stdout") else path
    output = current_output()
    if path is not None and path != Path("-") and not context.resilient_parsing:
        refuse_files(path, force=output.force)
    output.json_path = path


LOG = click.option(
    "--log",
    type=click.Path(path_type=Path),
    metavar="FILE",
    callback=_open_log,
    expose_value=False,
    cls=Option,
    heading=RUNNING,
    help="Add warnings, steps, seconds of each stage, results and errors to the end of FILE, with times.",
)
_PROGRESS = click.option(
    "--progress",
    type=click.Choice(list(PROGRESS)),
    default="auto",
    show_default=True,
    envvar="PSOTRACK_PROGRESS",
    callback=_take_progress,
    expose_value=False,
    cls=Option,
    heading=RUNNING,
    help="Progress on stderr. auto: a bar on a terminal, else lines now and then about work that takes long; bar: "
    "a bar in any case; lines: lines, and the seconds of each stage; none: nothing.",
)
JSON = click.option(
    "--json",
    "json_path",
    type=click.Path(path_type=Path),
    metavar="OUT",
    callback=_take_json,
    expose_value=False,
    cls=Option,
    heading=RUNNING,
    help="Write the results as JSON to OUT; - is stdout.",
)
CACHE = click.option(
    "--cache",
    type=click.Path(path_type=Path),
    envvar="PSOTRACK_CACHE",
    cls=Option,
    heading=RUNNING,
    help="Folder of silhouettes and compiled programs.  [default: $PSOTRACK_CACHE, or psotrack in your cache folder]",
)
JOBS = click.option(
    "--jobs",
    type=click.IntRange(min=1),
    cls=Option,
    heading=RUNNING,
    help="Largest number of processes.  [default: one per processor]",
)


def reporting(command: Command) -> Command:
    """Options of commands with long work: --quiet, --progress and --log."""
    return QUIET(_PROGRESS(LOG(command)))


def running(*, progress: bool = True, json: bool = True) -> Callable[[Command], Command]:
    """Give a command its `Output`, and the options that are not about the work itself.

    Args:
        progress: whether the work may take long: with --progress and --log.
        json: whether there are results for --json.
    """

    def decorate(command: Command) -> Command:
        command = pass_output(command)
        command = JSON(command) if json else command
        return FORCE(reporting(command) if progress else QUIET(command))

    return decorate


def positive(_: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    """Callback of an option whose value is a number above 0."""
    if value is not None:
        check_positive(parameter.opts[0], value)
    return value


def out_option(words: str, **attributes: Any) -> Callable[[Command], Command]:
    """Option `--out`: a path."""
    return click.option("--out", type=click.Path(path_type=Path), help=words, **attributes)


CAMERAS = click.option(
    "--cameras",
    type=Names(),
    help="Use these cameras only.  [default: all cameras of the calibration]",
)


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


BODIES = click.option(
    "--body",
    "bodies",
    multiple=True,
    metavar="NAME=LABEL,...",
    callback=_read_bodies,
    help="Markers of drone NAME in the C3D file of the reference; `cf1:` stands for all markers of the body cf1, and "
    "NAME alone for those of the body NAME; may be repeated.  [default: bodies called dron..., or rigid ones]",
)


def frames_option(command: Command) -> Command:
    """Add `--frames`, and name it as a way out where a video ends early."""

    @functools.wraps(command)
    def with_way_out(*args: Any, **options: Any) -> None:
        from psotrack.recordings import TruncatedVideoError

        try:
            command(*args, **options)
        except TruncatedVideoError as error:
            if not error.num_instants:
                raise
            raise error.with_way_on(f"--frames {error.num_instants} uses the time before") from None

    return click.option(
        "--frames", "num_frames", type=int, metavar="N", help="Use the first N frames only.  [default: all]"
    )(with_way_out)


@dataclass(frozen=True)
class Extent:
    """What of a recording is used, and by what.

    Attributes:
        cameras: names of the cameras; None are all.
        num_frames: number of frames from the first one; None are all.
        cache: folder of silhouettes and compiled programs; None is the usual one.
        jobs: largest number of processes; None is one per processor.
    """

    cameras: tuple[str, ...] | None
    num_frames: int | None
    cache: Path | None
    jobs: int | None

    @property
    def silhouettes(self) -> Path:
        """Folder of the stored silhouettes."""
        return cache_folder(self.cache)


def extent_options(command: Command) -> Command:
    """Add --cameras, --frames, --cache and --jobs; the command gets them as `extent`."""

    @functools.wraps(command)
    def with_extent(
        *args: Any,
        cameras: tuple[str, ...] | None,
        num_frames: int | None,
        cache: Path | None,
        jobs: int | None,
        **options: Any,
    ) -> None:
        command(*args, **options, extent=Extent(cameras, num_frames, cache, jobs))

    return CAMERAS(frames_option(CACHE(JOBS(with_extent))))


def dictionary_option(default: str = "4x4_1000") -> Callable[[Command], Command]:
    """Option `--dictionary`: the markers' dictionary."""
    return click.option(
        "--dictionary",
        default=default,
        show_default=True,
        help="Dictionary of the markers; any dictionary of OpenCV.",
    )


def plot_option(content: str, default_path: str) -> Callable[[Command], Command]:
    """Option `--plot [PNG]`: a picture of `content`, at `default_path` if no path follows; the value is then empty."""

    def check(_: click.Context, __: click.Parameter, path: Path | None) -> Path | None:
        if path is not None and path.name and path.suffix.lower() != ".png":
            raise SettingsError("--plot", expected="a file that ends in .png", found=path.name)
        return path

    return click.option(
        "--plot",
        type=click.Path(path_type=Path),
        callback=check,
        is_flag=False,
        flag_value="",
        metavar="[PNG]",
        help=f"Save {content}.  [default: {default_path}]",
    )


def filmed_recording(source: Path, extent: Extent) -> Recording:
    """The videos of a recording, calibrated or not, or a single video, or a folder of pictures as a recording."""
    from psotrack.recordings import is_picture_folder, open_video, recording_of_video, with_all_videos
    from psotrack.recordings.datasets import is_recording, open_recording

    if not source.exists():
        raise InputError(
            source, expected="a video, a folder of pictures, or a recording", found="no such file or folder"
        )
    if not is_recording(source) and (source.is_file() or is_picture_folder(source)):
        # Nothing that is made from the pictures depends on their rate.
        recording = recording_of_video(open_video(source, 1.0 if is_picture_folder(source) else None))
    else:
        recording = with_all_videos(open_recording(source))
    return recording.usable(extent.cameras, extent.num_frames)


def cache_folder(chosen: str | Path | None) -> Path:
    """Folder of the stored silhouettes: `chosen`, or the user's."""
    return Path(chosen) if chosen else user_cache()


def compiled_folder(chosen: str | Path | None) -> Path:
    """Folder of compiled programs, inside the folder of the silhouettes."""
    return cache_folder(chosen) / "compiled"


def beside(sequence: Path, name: str) -> Path:
    """Default of `--out`: `name` in the folder `results` of a recording, or beside an archive."""
    from psotrack.cli.archived import archive_of

    archive = archive_of(click.get_current_context())
    if archive is not None:
        return archive.path.with_suffix("") / name
    return (sequence if sequence.is_dir() else sequence.parent) / "results" / name


def detections_of(output: Output, recording: Recording) -> str:
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
    from psotrack.show.flights import find_recording

    found = given or find_recording(tracks)
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
    from psotrack.cli.archived import archive_of
    from psotrack.show.flights import recording_beside

    return "" if archive_of(click.get_current_context()) is not None else recording_beside(sequence, tracks)

"""Arguments and options that several commands share, with the defaults of the settings."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click
import platformdirs

from psotrack.cli.log_file import LogFile
from psotrack.cli.output import CHOSEN_PROGRESS, PROGRESS
from psotrack.errors import InputError, SettingsError
from psotrack.foreground.silhouettes import Shadows, SilhouetteSettings
from psotrack.settings import TrackSettings, setting_names
from psotrack.support import ARCHIVE_SUFFIX, refuse_files, whole_number

if TYPE_CHECKING:
    from psotrack.recordings import Recording

#: Settings whose values are the defaults of the command line.
TRACK = TrackSettings()
SILHOUETTES = SilhouetteSettings()
#: Side of a detector network's square input, pixels: the size that YOLO networks are trained with.
DETECTOR_SIZE = 640

Command = Callable[..., None]


class Numbers(click.ParamType):
    """`count` numbers with commas between them, such as 0.5,0.5,0.2."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.name = ",".join(["NUMBER"] * count)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Tuple of floats from a string; a value that is not a string is returned as it is."""
        if not isinstance(value, str):
            return value
        try:
            numbers = tuple(float(word) for word in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self.count:
            self.fail(f"expected {self.count} numbers with commas between them, found {value!r}", param, ctx)
        return numbers


class Size(click.ParamType):
    """Two whole numbers above 0, such as 1920,1080 or 7x5."""

    name = "W,H"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Pair of integers from a string; a value that is not a string is returned as it is."""
        if not isinstance(value, str):
            return value
        words = value.replace("x", ",").split(",")
        numbers = [whole_number(word) for word in words]
        if len(numbers) != 2 or not all(numbers):
            self.fail(f"expected two whole numbers above 0, such as 1920,1080, found {value!r}", param, ctx)
        return tuple(numbers)


class SequencePath(click.Path):
    """Path of a sequence. An archive is unpacked, and its folder is the path until the command ends."""

    name = "sequence"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; that of a temporary folder with the content of an archive."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        if ctx is None or ctx.resilient_parsing or path.suffix.lower() != ARCHIVE_SUFFIX or path.is_dir():
            return path
        from psotrack.cli.archived import opened_archive

        return opened_archive(ctx, path)


TRACKS = click.argument("tracks", type=click.Path(path_type=Path))
SEQUENCE = click.argument("sequence", metavar="SEQ", type=SequencePath(path_type=Path))
FORCE = click.option("--force", is_flag=True, help="Replace existing files.")
QUIET = click.option("--quiet", "-q", is_flag=True, help="Print no progress and no results, only errors.")


def reporting(command: Command) -> Command:
    """Options of commands with long work: `QUIET`; `--progress`, which `report_to` obeys; and `--log`."""

    def choose(context: click.Context, _: click.Parameter, chosen: str) -> str:
        context.meta[CHOSEN_PROGRESS] = chosen
        return chosen

    progress = click.option(
        "--progress",
        type=click.Choice(list(PROGRESS)),
        default="auto",
        show_default=True,
        envvar="PSOTRACK_PROGRESS",
        callback=choose,
        expose_value=False,
        help="Progress on stderr. auto: a bar on a terminal, else lines now and then about work that takes long; bar: "
        "a bar in any case; lines: lines, and the seconds of each stage; none: nothing.",
    )
    return QUIET(progress(LOG(command)))


def _open_log(context: click.Context, _: click.Parameter, path: Path | None) -> Path | None:
    context.meta["psotrack.log"] = path
    if path is not None and not context.resilient_parsing:
        # The outermost context ends after everything that the command says, its errors included.
        context.find_root().with_resource(LogFile(path))
    return path


LOG = click.option(
    "--log",
    type=click.Path(path_type=Path),
    metavar="FILE",
    callback=_open_log,
    expose_value=False,
    help="Add warnings, steps, seconds of each stage, results and errors to the end of FILE, with times.",
)


def _stdout_as_dash(_: click.Context, __: click.Parameter, path: Path | None) -> Path | None:
    """/dev/stdout is stdout, which then gets nothing but the JSON."""
    return Path("-") if path == Path("/dev/stdout") else path


def JSON(command: Command) -> Command:
    """Add `--json`; a file that cannot be written, or must not be replaced, is refused before the work."""

    @functools.wraps(command)
    def checking(*args: Any, json_path: Path | None, **options: Any) -> None:
        if json_path is not None and json_path != Path("-"):
            refuse_files(json_path, force=click.get_current_context().params.get("force", False))
        command(*args, json_path=json_path, **options)

    option = click.option(
        "--json",
        "json_path",
        type=click.Path(path_type=Path),
        metavar="OUT",
        callback=_stdout_as_dash,
        help="Write the results as JSON to OUT; - is stdout.",
    )
    return option(checking)


JOBS = click.option(
    "--jobs", type=click.IntRange(min=1), help="Largest number of processes.  [default: one per processor]"
)
CACHE = click.option(
    "--cache",
    type=click.Path(path_type=Path),
    envvar="PSOTRACK_CACHE",
    help="Folder of silhouettes and compiled programs.  [default: $PSOTRACK_CACHE, or psotrack in your cache folder]",
)
CAMERAS = click.option(
    "--cameras",
    metavar="NAME,NAME...",
    help="Use these cameras only.  [default: all cameras of the calibration]",
)
PARTICLES = click.option(
    "--particles",
    type=int,
    default=TRACK.swarm.particles,
    show_default=True,
    help="Number of particles of every swarm.",
)
ITERATIONS = click.option(
    "--iterations",
    type=click.IntRange(min=1),
    default=TRACK.swarm.iterations,
    show_default=True,
    help="Number of iterations per frame.",
)
MOST_DRONES = click.option(
    "--most-drones",
    type=click.IntRange(1, 1000),
    default=16,
    show_default=True,
    help="Largest number of drones at one time, where no frame uses a later one.",
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


FOV = click.option(
    "--fov",
    "fov_deg",
    type=Numbers(2),
    metavar="H,V",
    help="Horizontal and vertical field of view in degrees, instead of intrinsics.",
)
SCALE_CAMERA = click.option(
    "--scale-camera",
    is_flag=True,
    help="Scale the intrinsics to the size of the images; both must show the same field of view.",
)


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


def silhouette_options(command: Command) -> Command:
    """Options of `SilhouetteSettings`, for the commands that compute silhouettes."""
    for option in (
        click.option(
            "--background",
            default=SILHOUETTES.background,
            show_default=True,
            metavar="living|mog2|NAME",
            help="Background model: living goes on learning, for light, skies and plants that change; mog2 keeps the "
            "background as it was learned; NAME is a model that an installed package adds.",
        ),
        click.option(
            "--drone-px",
            type=float,
            default=None,
            metavar="PX",
            help="Width of the smallest drone in the images, from which reduction and smallest blob follow.  "
            "[default: the images' longer side / 48]",
        ),
        click.option(
            "--reduction",
            type=int,
            default=None,
            metavar="N",
            help="Image pixels per silhouette pixel, along each side.  [default: from --drone-px]",
        ),
        click.option(
            "--shadows",
            type=click.Choice(get_args(Shadows)),
            default=SILHOUETTES.shadows,
            show_default=True,
            help="Treatment of pixels that mog2 labels as shadow: shadows, but also dark bodies and rotor discs.",
        ),
        click.option(
            "--shadow-weight",
            type=float,
            default=SILHOUETTES.shadow_weight,
            show_default=True,
            help="Weight of a shadow pixel, for --shadows weight.",
        ),
        click.option(
            "--var-threshold",
            type=float,
            default=SILHOUETTES.var_threshold,
            show_default=True,
            help="Smallest squared distance of a foreground pixel from the background, in variances of the background, "
            "for mog2.",
        ),
        click.option(
            "--min-blob",
            "min_blob_px",
            type=int,
            default=None,
            metavar="N",
            help="Smallest foreground blob that is kept, in pixels.  [default: from --drone-px; 9 for living without "
            "--drone-px]",
        ),
    ):
        command = option(command)
    return command


#: Options whose settings have other names.
_SETTINGS = {
    "swarm": "swarm.kind",
    "score": "score.kind",
    "drones": "drones.count",
    "drone_size_m": "drones.size_m",
}


def setting_name(option: str) -> str:
    """Dotted name of the setting of `TrackSettings` that an option sets; the option's own name where there is none."""
    named = [name for name in setting_names() if name.rpartition(".")[2] == option]
    return _SETTINGS.get(option) or (named[0] if named else option)


def usable_recording(folder: str | Path, cameras: str | None, num_frames: int | None) -> Recording:
    """Recording with the cameras and frames that the options `CAMERAS` and `--frames` select."""
    from psotrack.recordings.datasets import open_recording

    return open_recording(folder).usable(camera_names(cameras), num_frames)


def filmed_recording(source: Path, cameras: str | None, num_frames: int | None) -> Recording:
    """The videos of a recording, calibrated or not, or a single video, or a folder of pictures as a recording."""
    from psotrack.recordings import is_picture_folder, open_video, recording_of_video, with_all_videos
    from psotrack.recordings.datasets import is_recording, open_recording

    if not source.exists():
        raise InputError(
            source, expected="a video, a folder of pictures, or a recording", found="no such file or folder"
        )
    if not is_recording(source):
        # Nothing that is made from the pictures depends on their rate.
        recording = recording_of_video(open_video(source, 1.0 if is_picture_folder(source) else None))
    else:
        recording = with_all_videos(open_recording(source))
    return recording.usable(camera_names(cameras), num_frames)


def camera_names(cameras: str | None) -> list[str] | None:
    """Names of the option `CAMERAS`; None where it is not given."""
    names = None if cameras is None else [name.strip() for name in cameras.split(",")]
    if names is not None and not all(names):
        raise SettingsError("--cameras", expected="names with commas between them", found=repr(cameras))
    return names


def cache_folder(chosen: str | Path | None) -> Path:
    """Folder of the stored silhouettes: `chosen`, or a folder in the user's cache folder."""
    return Path(chosen) if chosen else platformdirs.user_cache_path("psotrack") / "silhouettes"


def compiled_folder(chosen: str | Path | None) -> Path:
    """Folder of compiled programs, inside the folder of the silhouettes."""
    return cache_folder(chosen) / "compiled"

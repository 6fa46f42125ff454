"""What the commands have in common: arguments and options, with the defaults of the settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click
import platformdirs

from psotrack.settings import TrackSettings
from psotrack.silhouettes import Shadows, SilhouetteSettings

if TYPE_CHECKING:
    from psotrack.recordings import Sequence

#: Defaults are written once, in the settings; the command line shows them.
TRACK = TrackSettings()
SILHOUETTES = SilhouetteSettings()
#: Of a network's square input, pixels: what YOLO is trained with.
DETECTOR_SIZE = 640

Command = Callable[..., None]


class Numbers(click.ParamType):
    """Numbers with commas between them, such as 0.5,0.5,0.2."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.name = ",".join(["NUMBER"] * count)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """A tuple of floats; what is no string was converted before."""
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
        """A pair of integers; what is no string was converted before."""
        if not isinstance(value, str):
            return value
        words = value.replace("x", ",").split(",")
        if len(words) != 2 or not all(word.isdecimal() and int(word) > 0 for word in words):
            self.fail(f"expected two whole numbers above 0, such as 1920,1080, found {value!r}", param, ctx)
        return int(words[0]), int(words[1])


SEQUENCE = click.argument("sequence", metavar="SEQ", type=click.Path(path_type=Path))
FORCE = click.option("--force", is_flag=True, help="Replace what is there.")
QUIET = click.option("--quiet", "-q", is_flag=True, help="No progress, no table: errors only.")
JSON = click.option(
    "--json",
    "json_path",
    type=click.Path(path_type=Path),
    metavar="OUT",
    help="Write the answer as JSON; - is stdout.",
)
JOBS = click.option(
    "--jobs", type=click.IntRange(min=1), help="Processes at most.  [default: one per processor]"
)
CACHE = click.option(
    "--cache",
    type=click.Path(path_type=Path),
    envvar="PSOTRACK_CACHE",
    help="Of silhouettes and compiled programs.  [default: $PSOTRACK_CACHE, or psotrack in the user's cache folder]",
)
CAMERAS = click.option(
    "--cameras", metavar="NAME,NAME...", help="Use these cameras only.  [default: all of the calibration]"
)
FRAMES = click.option(
    "--frames", "num_frames", type=int, metavar="N", help="Use the first N frames only.  [default: all]"
)


def silhouette_options(command: Command) -> Command:
    """The options of `SilhouetteSettings` that users turn, for the commands that make silhouettes."""
    for option in (
        click.option(
            "--reduction",
            type=int,
            default=SILHOUETTES.reduction,
            show_default=True,
            help="Image pixels per silhouette pixel, along each side.",
        ),
        click.option(
            "--shadows",
            type=click.Choice(get_args(Shadows)),
            default=SILHOUETTES.shadows,
            show_default=True,
            help="What becomes of MOG2's shadow label: dark bodies and rotor discs get it as well as shadows.",
        ),
        click.option(
            "--shadow-weight",
            type=float,
            default=SILHOUETTES.shadow_weight,
            show_default=True,
            help="Of a shadow pixel, for --shadows weight.",
        ),
        click.option(
            "--var-threshold",
            type=float,
            default=SILHOUETTES.var_threshold,
            show_default=True,
            help="Squared distance from the background, in standard deviations, that is foreground.",
        ),
        click.option(
            "--min-blob",
            "min_blob_px",
            type=int,
            default=SILHOUETTES.min_blob_px,
            show_default=True,
            help="Smaller speckle is removed; in pixels.",
        ),
    ):
        command = option(command)
    return command


def usable_sequence(folder: Path, cameras: str | None, num_frames: int | None) -> Sequence:
    """What is to be used of a sequence, of what `CAMERAS` and `FRAMES` ask for."""
    from psotrack.datasets.dpjait import read_sequence

    return read_sequence(folder).usable(cameras.split(",") if cameras else None, num_frames)


def cache_folder(chosen: Path | None) -> Path:
    """Of the stored silhouettes."""
    return chosen or platformdirs.user_cache_path("psotrack") / "silhouettes"


def compiled_folder(chosen: Path | None) -> Path:
    """Of compiled programs, within that of the silhouettes."""
    return cache_folder(chosen) / "compiled"

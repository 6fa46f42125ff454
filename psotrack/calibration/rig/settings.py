"""What is known before a rig is calibrated: the board, the lenses, points instead of a board, and the world.

Commands make their options of these records, so this module imports nothing that takes long.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from psotrack.errors import SettingsError
from psotrack.support import check_records


@dataclass(frozen=True)
class BoardSettings:
    """The board that is moved before the cameras.

    Attributes:
        kind: kind of the board; a grid is one of ArUco markers or AprilTags; None: grid with --separation or --squares
            1x1, charuco with --marker, else chessboard.
        squares: number of squares of the board, of markers for a grid, such as 4x5.
        square_m: side of a square in metres.
        marker_m: side of a marker in metres.
        separation_m: gap between the markers of a grid in metres.
        dictionary: dictionary of the markers; any dictionary of OpenCV.
        first_marker: number of the first marker of a grid; the others count on from it, row by row.
    """

    kind: Literal["charuco", "chessboard", "grid"] | None = None
    squares: Annotated[tuple[int, int], Meta(extra={"metavar": "COLUMNSxROWS"})] | None = None
    square_m: float | None = None
    marker_m: float | None = None
    separation_m: float | None = None
    dictionary: str = "4x4_1000"
    first_marker: Annotated[int, Meta(ge=0)] = 0


@dataclass(frozen=True)
class LensSettings:
    """The lenses of the cameras.

    Attributes:
        lens: number of distortion coefficients of OpenCV's lens model, or its fisheye model; auto chooses by views that
            are left out.
        lenses: calibration whose lenses are kept; a camera that is not in the file gets a lens from the board.
        fov_deg: horizontal and vertical field of view in degrees, with `size`, instead of `lenses`.
        size: size of the images in pixels, if no file states it; lenses for another one of the same shape are rescaled.
    """

    lens: Annotated[str, Meta(extra={"metavar": "auto|0|4|5|8|12|14|fisheye"})] = "auto"
    lenses: Path | None = None
    fov_deg: Annotated[tuple[float, float], Meta(extra={"metavar": "H,V"})] | None = None
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class PointSettings:
    """What is seen instead of a board.

    Attributes:
        points: a single moving point instead of a board: the detections of the recording, or a CSV file with
            camera,frame,x_px,y_px (and point, for the two ends of a stick). Needs --lenses.
        distance: distance between two cameras' centres in metres, for --points: a,b=4.20.
        stick_m: distance of the two points in metres, for --points.
        pairs: points of known place, marked by hand, instead of a board: camera,point,x_px,y_px,x_m,y_m,z_m. Needs
            the lenses.
        places: positions of the points of --pairs, if it has none: point,x_m,y_m,z_m.
        markers: ArUco markers of known place instead of a board: a map of their corners. Needs the lenses.
        noise_px: a guess of the standard deviation of a point in the image, along x and along y, in pixels, with
            --pairs or --markers; it is learned from the residuals, beside which the guess counts as one point.
    """

    points: bool = False
    distance: tuple[str, str, float] | None = None
    stick_m: float | None = None
    pairs: Path | None = None
    places: Path | None = None
    markers: Path | None = None
    noise_px: float = 1.0


@dataclass(frozen=True)
class WorldSettings:
    """The names of the cameras, and the world.

    Attributes:
        names: names of the cameras; None: from the files' names.
        floor: frame in which the board lies on the floor: its first corner is the origin, and z points up; None: the
            first camera is the world.
        world: three or more points and where they are: point,x_m,y_m,z_m, where a point is a camera, or a frame of the
            moving point; with camera,x_px,y_px for points that are marked in the images of two cameras.
    """

    names: tuple[str, ...] | None = None
    floor: Annotated[int, Meta(extra={"metavar": "FRAME"})] | None = None
    world: Annotated[Path, Meta(extra={"metavar": "FILE"})] | None = None


@dataclass(frozen=True)
class RigSettings(WorldSettings, PointSettings, LensSettings, BoardSettings):
    """What is known before a rig is calibrated; of a board, the side of a square is enough.

    Its fields are those of `BoardSettings`, `LensSettings`, `PointSettings` and `WorldSettings`.
    """

    def __post_init__(self) -> None:
        chosen = {
            "--squares": self.squares is not None,
            "--points": self.points,
            "--pairs": self.pairs is not None,
            "--markers": self.markers is not None,
        }
        used = [name for name, is_chosen in chosen.items() if is_chosen]
        if not used and self.square_m is not None:
            used = ["--square"]
        if len(used) != 1:
            found = " and ".join(used) or "none"
            raise SettingsError("rig", expected=f"one of --square, {', '.join(chosen)}", found=found)
        if (self.distance or self.stick_m is not None) and not self.points:
            raise SettingsError("rig", expected="--distance and --stick with --points", found=used[0])
        if self.fov_deg is not None and self.by_board:
            raise SettingsError("--fov", expected="points or markers, not a board", found=used[0])
        if self.floor is not None and not self.by_board:
            raise SettingsError("rig", expected="--floor with --squares", found=used[0])
        if self.floor is not None and self.world is not None:
            raise SettingsError("rig", expected="--floor or --world", found="both")

    @property
    def by_board(self) -> bool:
        """Whether a board is moved before the cameras, and not points."""
        return not (self.points or self.pairs or self.markers)


check_records(RigSettings)

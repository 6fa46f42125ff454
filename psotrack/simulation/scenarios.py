"""Scenarios: small declarative records of who flies where, how, and before which cameras. Data, not code.

The thirteen of the dataset are the TOML files of `presets/`; a user's own is a file of the same form. Numbers of
drones count from 1, as in the names of the files that are written.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import msgspec

from psotrack.errors import InputError, SettingsError
from psotrack.support import assign, convert, read_toml

_PRESETS = resources.files("psotrack.simulation.presets")

Vector = tuple[float, float, float]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
GreyLevels = Annotated[float, msgspec.Meta(ge=0, le=255)]
#: More than anybody means; beyond it, a slip of the finger would fill the memory.
Count = Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]
Reflectance = tuple[Share, Share, Share]


class _Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of a scenario: immutable, unknown fields refused."""


# --- flights


class Harmonic(_Record, frozen=True, kw_only=True):
    """One term of a flight: `amplitude_m * sin(2 pi t / period_s + phase_deg)` along each axis."""

    amplitude_m: Vector
    period_s: Positive
    phase_deg: Vector = (0.0, 0.0, 0.0)


class Harmonics(_Record, frozen=True, kw_only=True, tag_field="kind", tag="harmonics"):
    """A sum of sinusoids about a centre."""

    centre_m: Vector
    terms: Annotated[tuple[Harmonic, ...], msgspec.Meta(min_length=1)]


class Orbit(_Record, frozen=True, kw_only=True, tag_field="kind", tag="orbit"):
    """An ellipse around a centre, rising and falling on the way; at phase 0 the drone is at +x.

    Attributes:
        radius_m: along x and y.
        clockwise: seen from above.
        rise_m, rise_period_s, rise_phase_deg: how far it rises and falls from the centre's height, and how slowly.
    """

    centre_m: Vector
    radius_m: tuple[NotNegative, NotNegative]
    period_s: Positive
    phase_deg: float = 0.0
    clockwise: bool = False
    rise_m: float = 0.0
    rise_period_s: Positive = 5.0
    rise_phase_deg: float = 0.0


class Crossing(_Record, frozen=True, kw_only=True, tag_field="kind", tag="crossing"):
    """To and fro between two points, slowing down at both ends; at phase 0 it starts at the first."""

    start_m: Vector
    end_m: Vector
    period_s: Positive
    phase_deg: float = 0.0


class Formation(_Record, frozen=True, kw_only=True, tag_field="kind", tag="formation"):
    """At a constant offset from another drone.

    Attributes:
        leader: its number.
    """

    leader: Count
    offset_m: Vector


class FollowingFlight(_Record, frozen=True, kw_only=True, tag_field="kind", tag="following"):
    """On the path of another drone, some time behind it.

    Attributes:
        leader: its number.
        delay_s: how long behind; ahead below 0.
    """

    leader: Count
    delay_s: float


class NearPass(_Record, frozen=True, kw_only=True, tag_field="kind", tag="near_pass"):
    """Past another drone, to and fro, at a stated distance: `side * distance_m + swing_m * sin(...)` from it.

    Attributes:
        other: the number of the drone that is passed.
        distance_m: between body origins when they are nearest, twice per period.
        side: on which side of the other it passes; any length, perpendicular to `swing_m`.
        swing_m: how far away it is at its farthest, in which direction.
    """

    other: Count
    distance_m: Positive
    side: Vector
    swing_m: Vector
    period_s: Positive
    phase_deg: float = 0.0


class Waypoints(_Record, frozen=True, kw_only=True, tag_field="kind", tag="waypoints"):
    """From point to point, from rest to rest, as people fly by hand; after the last comes the first again.

    Attributes:
        speed_m_s: mean speed between two points.
        hover_s: how long it stands still at each.
    """

    points_m: Annotated[tuple[Vector, ...], msgspec.Meta(min_length=2)]
    speed_m_s: Positive
    hover_s: NotNegative = 1.0


class FlightFromFile(_Record, frozen=True, kw_only=True, tag_field="kind", tag="recording"):
    """What was recorded before: a CSV of positions and, where it has them, orientations, at any rate.

    Attributes:
        file: its path; a relative one starts at the scenario's file.
        start_s: of the recording, which becomes the first frame.
        offset_m: added to its positions.
    """

    file: str
    start_s: NotNegative = 0.0
    offset_m: Vector = (0.0, 0.0, 0.0)


FlightRecord = (
    Harmonics | Orbit | Crossing | Formation | FollowingFlight | NearPass | Waypoints | FlightFromFile
)


# --- drones


class Rotor(_Record, frozen=True, kw_only=True):
    """A rotor of a mesh: its hub and its radius, in the body frame."""

    centre_m: Vector
    radius_m: Positive


class Mesh(_Record, frozen=True, kw_only=True):
    """A user's own drone: a mesh file, OBJ or PLY.

    Attributes:
        file: its path; a relative one starts at the scenario's file.
        scale: metres per unit of the file.
        origin_m: the point of the scaled mesh that is the body origin; x is ahead, z up.
        rotors: none are drawn unless they are listed here.
    """

    file: str
    scale: Positive = 1.0
    origin_m: Vector = (0.0, 0.0, 0.0)
    rotors: tuple[Rotor, ...] = ()


class Drone(_Record, frozen=True, kw_only=True):
    """A drone: its shape, its paint, and its flight.

    Attributes:
        model: a name in `world.drones.MODELS`, or a mesh.
        paint_bgr: reflectance of its paint, linear, 0 to 1 (dark grey is 0.1).
        group: drones of one group are varied alike by a seed, so that what keeps them apart stays.
        yaw_deg, yaw_sway_deg, yaw_period_s: heading, and how far and how slowly it turns to and fro; a recording with
            orientations has its own.
    """

    flight: FlightRecord
    model: str | Mesh = "x_frame"
    paint_bgr: Reflectance = (0.03, 0.03, 0.03)
    group: str = ""
    yaw_deg: float = 0.0
    yaw_sway_deg: NotNegative = 40.0
    yaw_period_s: Positive = 9.0


# --- cameras and what they see


class CameraPlace(_Record, frozen=True, kw_only=True):
    """Where a camera hangs and looks, with intrinsics for pictures of the scenario's `image_size_wh`."""

    position_m: Vector
    target_m: Vector
    focal_length_px: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 1156.3
    principal_point_px: tuple[float, float] = (960.0, 540.0)


class CameraSpread(_Record, frozen=True, kw_only=True):
    """How far cameras differ from their records, drawn with the seed: standard deviations, 0 for not at all.

    Attributes:
        focal_length: relative.
        principal_point_px: along x and along y.
    """

    focal_length: Annotated[float, msgspec.Meta(ge=0, le=0.2)] = 0.0
    principal_point_px: NotNegative = 0.0


class OnboardCamera(_Record, frozen=True, kw_only=True):
    """The camera on each drone, fixed to its body (the `_A` sequences).

    Attributes:
        fov_deg: horizontal and vertical field of view (the paper's GoPro has 92.45 x 60.83).
        position_m: of its centre, in the body frame.
        pitch_deg: how far it looks up (above 0) or down from straight ahead.
        shutter_s: exposure time.
    """

    image_size_wh: tuple[Count, Count] = (1920, 1080)
    fov_deg: tuple[Positive, Positive] = (92.45, 60.83)
    position_m: Vector = (0.12, 0.0, 0.03)
    pitch_deg: float = 0.0
    shutter_s: Positive = 1 / 500


class Imaging(_Record, frozen=True, kw_only=True):
    """What makes pictures look like a camera's. Every effect is off at 0 (or false).

    Attributes:
        antialiasing: edges without stairs.
        shutter_s: exposure time, which blurs what moves.
        lens_blur_px: standard deviation.
        shadows: soft shadows of the lamps on the floor.
        contact_shadows: the dark under what is close to the floor, where ambient light does not get.
        reflections: share of light that the floor mirrors when looked at steeply; it grows towards grazing angles.
        exposure_drift: standard deviation of the slow relative change of brightness, per camera.
        white_balance_drift: the same for colours against one another.
        flicker: how far lamps dim between two half waves of the mains.
        mains_hz: the mains' frequency; that of the lamps is twice this.
        read_noise: standard deviation at black, in grey levels.
        shot_noise: standard deviation at full scale, in grey levels; grows with the root of brightness.
        jpeg_quality: 1 to 100, as cameras that send JPEG have it; blocks show below 40; 0 is no JPEG at all.
    """

    antialiasing: bool = True
    shutter_s: NotNegative = 1 / 125
    lens_blur_px: Annotated[float, msgspec.Meta(ge=0, le=50)] = 0.3
    shadows: bool = True
    contact_shadows: bool = True
    reflections: Share = 0.04
    exposure_drift: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.01
    white_balance_drift: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.005
    flicker: Share = 0.1
    mains_hz: Positive = 50.02
    read_noise: GreyLevels = 1.0
    shot_noise: GreyLevels = 3.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=0, le=100)] = 0


class SimulatedDetector(_Record, frozen=True, kw_only=True):
    """The noise of a detector of boxes, with what a good network does on such videos as default.

    Attributes:
        jitter: standard deviation of a box's middle and size, as a share of its size.
        miss_rate: of drones that are seen whole and large; what is hidden or small is missed more often.
        double_rate: share of drones that get a second box.
        false_alarms_per_frame: mean number, per camera.
        merge_iou: boxes of two drones that overlap more become one.
    """

    jitter: NotNegative = 0.04
    miss_rate: Share = 0.03
    double_rate: Share = 0.01
    false_alarms_per_frame: Annotated[float, msgspec.Meta(ge=0, le=1000)] = 0.02
    merge_iou: Share = 0.45


# --- the whole


class Limits(_Record, frozen=True, kw_only=True):
    """What every flight of a scenario keeps to, whatever the seed.

    Attributes:
        min_distance_m: between any two drones, except those that the scenario lets pass nearer.
        lower_m, upper_m: corners of the box that body origins stay in.
    """

    max_speed_m_s: Positive
    max_acceleration_m_s2: Positive
    max_tilt_deg: Annotated[float, msgspec.Meta(gt=0, lt=90)]
    min_distance_m: NotNegative
    lower_m: Vector
    upper_m: Vector


class Variation(_Record, frozen=True, kw_only=True):
    """How far a seed moves flights; recordings, and offsets, distances and delays from other drones, stay as they are.

    Attributes:
        phase_deg: of sinusoids, to either side.
        centre_m: of centres and waypoints, to either side, along each axis.
        size: of sinusoids, relative, to either side.
        period: of sinusoids, and of the way around waypoints; relative, to either side.
        yaw_deg: of headings, to either side.
    """

    phase_deg: NotNegative = 25.0
    centre_m: NotNegative = 0.15
    size: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.06
    period: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.04
    yaw_deg: NotNegative = 45.0


class Scenario(_Record, frozen=True, kw_only=True):
    """One sequence to simulate.

    Attributes:
        description: one line for people.
        hall: a name in `world.halls.HALLS`.
        cameras: where they are, or the name of a rig in `world.halls.RIGS`.
        num_frames: as long as flights are planned for.
        limits: what flights keep to.
        fps: frames per second.
        image_size_wh: of the cameras at full size; fewer pixels than their intrinsics are for are a smaller field of
            view.
        markers: whether ArUco markers hang on the walls.
        onboard: the camera on each drone; none without it.
    """

    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    description: str = ""
    hall: str
    cameras: str | Annotated[tuple[CameraPlace, ...], msgspec.Meta(min_length=1)]
    num_frames: Count
    drones: Annotated[tuple[Drone, ...], msgspec.Meta(min_length=1)]
    limits: Limits
    fps: Annotated[float, msgspec.Meta(ge=0.1, le=1000)] = 25.0
    image_size_wh: tuple[Count, Count] = (1920, 1080)
    markers: bool = False
    onboard: OnboardCamera | None = None
    camera_spread: CameraSpread = CameraSpread()
    imaging: Imaging = Imaging()
    detector: SimulatedDetector = SimulatedDetector()
    variation: Variation = Variation()


def scenario(name: str) -> Scenario:
    """The scenario of that name.

    Raises:
        SettingsError: there is none; the message lists those there are.
    """
    return msgspec.toml.decode(preset_text(name), type=Scenario)


def preset_names() -> tuple[str, ...]:
    """The names of the scenarios that come with the package, in order."""
    return tuple(
        sorted(path.name.removesuffix(".toml") for path in _PRESETS.iterdir() if path.name.endswith(".toml"))
    )


def preset_text(name: str) -> str:
    """The file of a scenario that comes with the package, a model for one's own.

    Raises:
        SettingsError: there is none of that name; the message lists those there are.
    """
    names = preset_names()
    if name not in names:
        raise SettingsError("scenario", expected=f"one of {', '.join(names)}", found=name)
    return _PRESETS.joinpath(f"{name}.toml").read_text(encoding="utf-8")


def wrong(recipe: Scenario, field: str, *, expected: str, found: str, remedy: str = "") -> SettingsError:
    """The error that names a field of a scenario whose value is of the right kind but makes no sense there."""
    return SettingsError(f"scenario {recipe.name}: {field}", expected=expected, found=found, remedy=remedy)


def load(path: str | Path) -> Scenario:
    """The scenario in a TOML file of the same form as the presets; paths in it start at its folder.

    Raises:
        InputError: the file cannot be read, is no TOML, or has a wrong field, which the message names.
    """

    def error(field: str, expected: str, found: str, remedy: str) -> InputError:
        return InputError(f"{path}: {field}", expected=expected, found=found, remedy=remedy)

    recipe = convert(read_toml(path), Scenario, error)
    folder = Path(path).resolve().parent
    return msgspec.structs.replace(recipe, drones=tuple(_located(drone, folder) for drone in recipe.drones))


def replaced(recipe: Scenario, changes: Mapping[str, Any]) -> Scenario:
    """The scenario with other values in some of its fields.

    Args:
        changes: dotted path of a field -> plain value, as TOML has them:
            `{"imaging.reflections": 0, "drones[0].model": "tall_cross"}`.

    Raises:
        SettingsError: there is no such field, or the value does not fit it; the message names the field.
    """

    def error(field: str, expected: str, found: str, remedy: str) -> SettingsError:
        return SettingsError(field, expected=expected, found=found, remedy=remedy)

    data = msgspec.json.decode(msgspec.json.encode(recipe))
    for path, value in changes.items():
        assign(data, path, value, error)
    return convert(data, Scenario, error)


def _located(drone: Drone, folder: Path) -> Drone:
    """The drone with the paths of its files made absolute."""
    files = {
        field: msgspec.structs.replace(part, file=str(folder / part.file))
        for field, part in (("flight", drone.flight), ("model", drone.model))
        if isinstance(part, FlightFromFile | Mesh)
    }
    return msgspec.structs.replace(drone, **files)


def frames_of(recipe: Scenario, wanted: int | None) -> int:
    """How many frames to make: all, or the first so many.

    Raises:
        SettingsError: the scenario has not so many.
    """
    if wanted is None:
        return recipe.num_frames
    if not 0 < wanted <= recipe.num_frames:
        raise SettingsError(
            "frames", expected=f"1 to {recipe.num_frames}, as many as {recipe.name} has", found=f"{wanted}"
        )
    return wanted

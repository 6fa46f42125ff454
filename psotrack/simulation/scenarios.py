"""Scenarios: records that describe drones, flights, cameras, hall and imaging of a simulated sequence.

The thirteen scenarios of the dataset are the TOML files in `presets/`; users write files of the same form. Drone
numbers start at 1, as in the names of the written files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import msgspec

from psotrack.errors import SettingsError
from psotrack.support import NotNegative, Positive, Share, assign, convert, read_toml

_PRESETS = resources.files("psotrack.simulation.presets")

Vector = tuple[float, float, float]
#: Seconds, and m/s. Smaller values are far below those of any flight or lamp, and a division by them may overflow.
Period = Annotated[float, msgspec.Meta(ge=1e-3)]
Speed = Annotated[float, msgspec.Meta(ge=1e-3)]
GreyLevels = Annotated[float, msgspec.Meta(ge=0, le=255)]
#: Counts have an upper limit, far above all useful values, so that a mistyped number does not fill the memory.
Count = Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]
Reflectance = tuple[Share, Share, Share]


class _Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the parts of a scenario: immutable, unknown fields are refused."""


# --- flights


class Harmonic(_Record, frozen=True, kw_only=True):
    """One term of a flight of sinusoids: `amplitude_m * sin(2 pi t / period_s + phase_deg)` along each axis.

    Attributes:
        amplitude_m: amplitude along x, y and z.
        period_s: period.
        phase_deg: phase at time 0, along x, y and z.
    """

    amplitude_m: Vector
    period_s: Period
    phase_deg: Vector = (0.0, 0.0, 0.0)


class Harmonics(_Record, frozen=True, kw_only=True, tag_field="kind", tag="harmonics"):
    """A flight that is a sum of sinusoids about a centre.

    Attributes:
        centre_m: centre of the flight, world.
        terms: the sinusoids.
    """

    centre_m: Vector
    terms: Annotated[tuple[Harmonic, ...], msgspec.Meta(min_length=1)]


class Orbit(_Record, frozen=True, kw_only=True, tag_field="kind", tag="orbit"):
    """A flight on an ellipse around a centre, with a sinusoidal change of height; at phase 0 the drone is at +x.

    Attributes:
        centre_m: centre of the ellipse, world.
        radius_m: radii along x and y.
        period_s: time of one revolution.
        phase_deg: angle on the ellipse at time 0.
        clockwise: direction of the flight, seen from above.
        rise_m: amplitude of the change of height.
        rise_period_s: period of the change of height.
        rise_phase_deg: phase of the change of height at time 0.
    """

    centre_m: Vector
    radius_m: tuple[NotNegative, NotNegative]
    period_s: Period
    phase_deg: float = 0.0
    clockwise: bool = False
    rise_m: float = 0.0
    rise_period_s: Period = 5.0
    rise_phase_deg: float = 0.0


class Crossing(_Record, frozen=True, kw_only=True, tag_field="kind", tag="crossing"):
    """A flight back and forth between two points, slower near both; at phase 0 the drone starts at the first point.

    Attributes:
        start_m: first point, world.
        end_m: second point, world.
        period_s: time from the first point to the second point and back.
        phase_deg: phase of the movement at time 0.
    """

    start_m: Vector
    end_m: Vector
    period_s: Period
    phase_deg: float = 0.0


class Formation(_Record, frozen=True, kw_only=True, tag_field="kind", tag="formation"):
    """A flight at a constant offset from another drone.

    Attributes:
        leader: number of the other drone; the first drone has number 1.
        offset_m: position relative to the other drone, world axes.
    """

    leader: Count
    offset_m: Vector


class FollowingFlight(_Record, frozen=True, kw_only=True, tag_field="kind", tag="following"):
    """A flight on the path of another drone, later or earlier than that drone.

    Attributes:
        leader: number of the other drone; the first drone has number 1.
        delay_s: delay after the other drone; negative if this drone flies ahead.
    """

    leader: Count
    delay_s: float


class NearPass(_Record, frozen=True, kw_only=True, tag_field="kind", tag="near_pass"):
    """A flight back and forth past another drone, at the offset `side * distance_m + swing_m * sin(...)` from it.

    Attributes:
        other: number of the other drone; the first drone has number 1.
        distance_m: smallest distance between the body origins, reached twice per period.
        side: direction from the other drone to this drone when the distance is smallest; of any length, perpendicular
            to `swing_m`.
        swing_m: amplitude of the movement past the other drone, a vector in world axes.
        period_s: period of the movement.
        phase_deg: phase of the movement at time 0.
    """

    other: Count
    distance_m: Positive
    side: Vector
    swing_m: Vector
    period_s: Period
    phase_deg: float = 0.0


class Waypoints(_Record, frozen=True, kw_only=True, tag_field="kind", tag="waypoints"):
    """A closed flight through points, with a stop at each point, as people fly by hand.

    Attributes:
        points_m: the points, world; the first point follows the last.
        speed_m_s: mean speed between two points.
        hover_s: time that the drone stands still at each point.
    """

    points_m: Annotated[tuple[Vector, ...], msgspec.Meta(min_length=2)]
    speed_m_s: Speed
    hover_s: NotNegative = 1.0


class FlightFromFile(_Record, frozen=True, kw_only=True, tag_field="kind", tag="recording"):
    """A recorded flight: tracks of one drone, at any rate.

    Attributes:
        file: path of the tracks in any format that psotrack reads (.csv, .parquet, .json, .tum, .mcap); a relative path
            starts at the folder of the scenario's file.
        start_s: time in the recorded flight that becomes the first frame.
        offset_m: vector that is added to the positions.
    """

    file: str
    start_s: NotNegative = 0.0
    offset_m: Vector = (0.0, 0.0, 0.0)


FlightRecord = (
    Harmonics | Orbit | Crossing | Formation | FollowingFlight | NearPass | Waypoints | FlightFromFile
)


# --- drones


class Rotor(_Record, frozen=True, kw_only=True):
    """A rotor of a mesh.

    Attributes:
        centre_m: centre of the hub, in the body frame.
        radius_m: radius of the rotor.
    """

    centre_m: Vector
    radius_m: Positive


class Mesh(_Record, frozen=True, kw_only=True):
    """A drone model from a mesh file, OBJ or PLY.

    Attributes:
        file: path of the mesh; a relative path starts at the folder of the scenario's file.
        scale: metres per unit of the file.
        origin_m: point of the scaled mesh that is the body origin; x is ahead, z is up.
        rotors: rotors to draw; empty: no rotors.
    """

    file: str
    scale: Positive = 1.0
    origin_m: Vector = (0.0, 0.0, 0.0)
    rotors: tuple[Rotor, ...] = ()


class Drone(_Record, frozen=True, kw_only=True):
    """A drone: model, paint and flight.

    Attributes:
        flight: the flight.
        model: x_frame, x_frame_racer, camera_drone, hexacopter, tall_cross, or a mesh.
        paint_bgr: reflectance of the paint, linear, 0 to 1 (dark grey is 0.1).
        group: name of a group; a seed changes the flights of a group in the same way, so that the drones of the group
            keep their distances.
        yaw_deg: mean heading; recorded flights with orientations use none of the three attributes `yaw_*`.
        yaw_sway_deg: amplitude of the sinusoidal change of heading.
        yaw_period_s: period of the change of heading.
    """

    flight: FlightRecord
    model: str | Mesh = "x_frame"
    paint_bgr: Reflectance = (0.03, 0.03, 0.03)
    group: str = ""
    yaw_deg: float = 0.0
    yaw_sway_deg: NotNegative = 40.0
    yaw_period_s: Period = 9.0


# --- cameras and what they see


class CameraPlace(_Record, frozen=True, kw_only=True):
    """Position, viewing direction and intrinsics of a static camera, for images of the scenario's `image_size_wh`.

    Attributes:
        position_m: camera centre, world.
        target_m: point that the camera looks at, world.
        focal_length_px: focal length along the rows.
        principal_point_px: principal point.
        aspect: focal length along the columns, as a multiple of that along the rows.
        skew_px: skew, pixels.
        distortion: coefficients in OpenCV's order: 0, 4, 5, 8, 12 or 14; 0 or 4 of a fisheye.
        fisheye: whether the lens has OpenCV's fisheye model.
    """

    position_m: Vector
    target_m: Vector
    focal_length_px: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 1156.3
    principal_point_px: tuple[float, float] = (960.0, 540.0)
    aspect: Annotated[float, msgspec.Meta(ge=0.1, le=10)] = 1.0
    skew_px: float = 0.0
    distortion: tuple[float, ...] = ()
    fisheye: bool = False


class OnboardCamera(_Record, frozen=True, kw_only=True):
    """The on-board camera of each drone, fixed to the drone's body (the `_A` sequences).

    Attributes:
        image_size_wh: width and height of the images at full size, pixels.
        fov_deg: horizontal and vertical field of view (the paper's GoPro has 92.45 x 60.83).
        position_m: camera centre in the body frame.
        pitch_deg: angle of the viewing direction above the drone's x axis; negative below.
        shutter_s: exposure time of a row.
        line_time_s: time from the exposure of one row to that of the next row at full size; 0 is a global
            shutter. A frame has the time of its middle row.
        distortion: coefficients of the lens in OpenCV's order: 0, 4, 5, 8, 12 or 14.
        exposure: smallest and largest factor of the light of the images, between which an automatic exposure swings.
        exposure_period_s: time of one swing of the automatic exposure.
    """

    image_size_wh: tuple[Count, Count] = (1920, 1080)
    fov_deg: tuple[Positive, Positive] = (92.45, 60.83)
    position_m: Vector = (0.12, 0.0, 0.03)
    pitch_deg: float = 0.0
    shutter_s: Positive = 1 / 500
    line_time_s: NotNegative = 0.0
    distortion: tuple[float, ...] = ()
    exposure: tuple[Positive, Positive] = (1.0, 1.0)
    exposure_period_s: Period = 4.0


class Imaging(_Record, frozen=True, kw_only=True):
    """Effects of a real camera and of real light. Each effect is off at 0 (or false).

    Attributes:
        antialiasing: whether edges are smoothed.
        shutter_s: exposure time, which decides the motion blur.
        lens_blur_px: standard deviation of the lens's blur.
        shadows: whether drones cast soft shadows of the lamps on the floor.
        reflections: share of light that the floor reflects at normal incidence; the share grows towards grazing angles.
        exposure_drift: standard deviation of the slow relative change of brightness, per camera.
        exposure: smallest and largest factor of the light of the static cameras' images, between which an automatic
            exposure swings, per camera; equal factors are no swing.
        exposure_period_s: time of one swing of the automatic exposure.
        white_balance_drift: standard deviation of the slow relative change of the colour channels, per camera.
        flicker: relative drop of the lamps' light between two half waves of the mains.
        mains_hz: frequency of the mains; the lamps flicker at twice this frequency.
        read_noise: standard deviation of the noise at black, grey levels.
        shot_noise: standard deviation of the noise at full scale, grey levels; proportional to the square root of
            brightness.
        jpeg_quality: quality of the JPEG compression in the camera, 1 to 100; blocks are visible below 40; 0 is no JPEG
            compression.
    """

    antialiasing: bool = True
    shutter_s: NotNegative = 1 / 125
    lens_blur_px: Annotated[float, msgspec.Meta(ge=0, le=50)] = 0.3
    shadows: bool = True
    reflections: Share = 0.04
    exposure_drift: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.01
    exposure: tuple[Positive, Positive] = (1.0, 1.0)
    exposure_period_s: Period = 7.0
    white_balance_drift: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.005
    flicker: Share = 0.1
    mains_hz: Positive = 50.02
    read_noise: GreyLevels = 1.0
    shot_noise: GreyLevels = 3.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=0, le=100)] = 0


class Surroundings(_Record, frozen=True, kw_only=True):
    """What changes around the drones in the videos of static cameras. Each change is off at 0.

    Every camera has a lamp, screen, leaves and person of its own, at places that the seed chooses. They are drawn in
    the image and not in the hall: they are behind all drones, cameras do not see the same ones, and on-board cameras
    and the reflections in the floor show none of it.

    Attributes:
        lamp_drop: share of the light that half of each image loses while a lamp is off, drones included.
        lamp_s: times at which the lamp goes off, on, off and so on; equal in all cameras.
        screen: share of each image that a bright screen with moving content covers.
        foliage: share of each image that swaying leaves cover: a plant in a room (0.03), or trees (0.3).
        person: height of a person, as a share of the image's height, who walks in and out at the side of each image.
        person_period_s: time from one entrance of the person to the next.
    """

    lamp_drop: Share = 0.0
    lamp_s: tuple[NotNegative, ...] = (3.2,)
    screen: Annotated[float, msgspec.Meta(ge=0, le=0.25)] = 0.0
    foliage: Annotated[float, msgspec.Meta(ge=0, le=0.9)] = 0.0
    person: Share = 0.0
    person_period_s: Period = 8.0


class SimulatedDetector(_Record, frozen=True, kw_only=True):
    """Errors of a simulated detector of boxes; the defaults are those of a good network on similar videos.

    Attributes:
        jitter: standard deviation of a box's middle and size, as a share of the box's size.
        miss_rate: share of missed detections of large, fully visible drones; hidden or small drones are missed more
            often.
        double_rate: share of drones with a second box.
        false_alarms_per_frame: mean number of false alarms per frame and camera.
        merge_iou: overlap above which the boxes of two drones become one box.
    """

    jitter: NotNegative = 0.04
    miss_rate: Share = 0.03
    double_rate: Share = 0.01
    false_alarms_per_frame: Annotated[float, msgspec.Meta(ge=0, le=1000)] = 0.02
    merge_iou: Share = 0.45


# --- the whole


class Limits(_Record, frozen=True, kw_only=True):
    """Limits that the flights of a scenario keep for every seed.

    Attributes:
        max_speed_m_s: largest speed.
        max_acceleration_m_s2: largest acceleration.
        max_tilt_deg: largest angle between a drone's z axis and the vertical.
        min_distance_m: smallest distance between two drones; the two drones of a near pass may be closer.
        lower_m: lower corner of the box that the body origins stay in, world.
        upper_m: upper corner of this box, world.
    """

    max_speed_m_s: Positive
    max_acceleration_m_s2: Positive
    max_tilt_deg: Annotated[float, msgspec.Meta(gt=0, lt=90)]
    min_distance_m: NotNegative
    lower_m: Vector
    upper_m: Vector


class Variation(_Record, frozen=True, kw_only=True):
    """Largest changes that a seed makes to flights, in both directions.

    Recorded flights do not change, nor do offsets, distances and delays relative to other drones.

    Attributes:
        phase_deg: largest change of a sinusoid's phase.
        centre_m: largest change of a centre or waypoint along each axis.
        size: largest relative change of a sinusoid's amplitude.
        period: largest relative change of a sinusoid's period, and of the time of a round through waypoints.
        yaw_deg: largest change of a heading.
    """

    phase_deg: NotNegative = 25.0
    centre_m: NotNegative = 0.15
    size: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.06
    period: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.04
    yaw_deg: NotNegative = 45.0


class Scenario(_Record, frozen=True, kw_only=True):
    """Description of one simulated sequence.

    Attributes:
        name: name of the sequence's folder.
        description: one line about the flights.
        hall: laboratory or large_hall.
        cameras: the static cameras; or laboratory, laboratory_corners or large_hall.
        num_frames: number of frames that the flights are planned for.
        drones: the drones.
        limits: limits of the flights.
        fps: frames per second.
        image_size_wh: width and height of the static cameras' images at full size, pixels; the intrinsics do not change
            with the size, so a smaller image has a smaller field of view.
        markers: whether ArUco markers hang on the walls.
        onboard: on-board camera of each drone; None: no on-board cameras.
        imaging: effects of camera and light.
        surroundings: what changes around the drones.
        detector: errors of the simulated detector.
        variation: changes that a seed makes to the flights.
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
    imaging: Imaging = Imaging()
    surroundings: Surroundings = Surroundings()
    detector: SimulatedDetector = SimulatedDetector()
    variation: Variation = Variation()


@dataclass(frozen=True)
class SimulationSettings:
    """Settings of a simulation. Scenario and settings together decide every byte of the sequence.

    Attributes:
        num_frames: simulate the first N frames only; None: all.
        scale: scale of the image size; 1 is full size.
        seed: seed of flights and noise, 0 or more.
        masks: write drone_masks.zip.
        onboard: render the videos of on-board cameras, if the scenario has any.
    """

    num_frames: Annotated[int, msgspec.Meta(extra={"metavar": "N"})] | None = None
    scale: float = 1.0
    seed: int = 0
    masks: bool = True
    onboard: bool = True


#: Changes of a scenario that make its surroundings restless: an automatic exposure that changes grey levels by 15 % to
#: both sides (a factor g of grey levels is g^2.2 of light), a lamp that goes off and takes 12 % of the grey levels of
#: half of each image, a screen and a plant.
RESTLESS: Mapping[str, Any] = {
    "imaging.exposure": [0.7, 1.36],
    "imaging.exposure_period_s": 7.0,
    "surroundings.lamp_drop": 0.245,
    "surroundings.lamp_s": [3.2],
    "surroundings.screen": 0.025,
    "surroundings.foliage": 0.025,
}


def scenario(name: str) -> Scenario:
    """Scenario of the package with a given name.

    Raises:
        SettingsError: no scenario has this name; the message lists the names.
    """
    return msgspec.toml.decode(preset_text(name), type=Scenario)


def preset_names() -> tuple[str, ...]:
    """Names of the package's scenarios, sorted."""
    return tuple(
        sorted(path.name.removesuffix(".toml") for path in _PRESETS.iterdir() if path.name.endswith(".toml"))
    )


def preset_text(name: str) -> str:
    """Text of the TOML file of a scenario of the package.

    Raises:
        SettingsError: no scenario has this name; the message lists the names.
    """
    names = preset_names()
    if name not in names:
        raise SettingsError("scenario", expected=f"one of {', '.join(names)}", found=name)
    return _PRESETS.joinpath(f"{name}.toml").read_text(encoding="utf-8")


def scenario_error(
    recipe: Scenario, field: str, expected: str, found: object, remedy: str = ""
) -> SettingsError:
    """Error about a field of a scenario whose value has the right type but is not possible."""
    found = f"{list(found) if isinstance(found, tuple) else found}"
    return SettingsError(f"scenario {recipe.name}: {field}", expected=expected, found=found, remedy=remedy)


def load(path: str | Path) -> Scenario:
    """Read a scenario from a TOML file of the same form as the presets; relative paths start at the file's folder.

    Raises:
        InputError: the file cannot be read, is not valid TOML, or has a wrong field; the message names the field.
    """
    recipe = convert(read_toml(path), Scenario, f"{path}: ")
    folder = Path(path).resolve().parent
    return msgspec.structs.replace(recipe, drones=tuple(_located(drone, folder) for drone in recipe.drones))


def change_scenario(recipe: Scenario, changes: Mapping[str, Any]) -> Scenario:
    """Copy of a scenario with other values in some fields.

    Args:
        recipe: the scenario.
        changes: new plain values, as in TOML, by dotted path of the field:
            `{"imaging.reflections": 0, "drones[0].model": "tall_cross"}`.

    Raises:
        SettingsError: a field does not exist, or a value does not fit the field; the message names the field.
    """
    data = msgspec.json.decode(msgspec.json.encode(recipe))
    for path, value in changes.items():
        assign(data, path, value)
    return convert(data, Scenario, error=SettingsError)


def _located(drone: Drone, folder: Path) -> Drone:
    """Copy of a drone with absolute paths of its files."""
    files = {
        field: msgspec.structs.replace(part, file=str(folder / part.file))
        for field, part in (("flight", drone.flight), ("model", drone.model))
        if isinstance(part, FlightFromFile | Mesh)
    }
    return msgspec.structs.replace(drone, **files)


def count_frames(recipe: Scenario, wanted: int | None) -> int:
    """Number of frames to simulate: `wanted`, or all frames of the scenario if `wanted` is None.

    Raises:
        SettingsError: `wanted` is below 1, or larger than the scenario's number of frames.
    """
    if wanted is None:
        return recipe.num_frames
    if not 0 < wanted <= recipe.num_frames:
        raise SettingsError(
            "frames", expected=f"1 to {recipe.num_frames}, the length of {recipe.name}", found=f"{wanted}"
        )
    return wanted

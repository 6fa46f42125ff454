"""Settings of tracking: one checked record, the same for the command line, sweeps and Python.

Defaults stand here and nowhere else. The record is nested by part: a name such as `swarm.particles` is the same in TOML
files, in sweeps and as attributes. Importing this module loads no JAX, so that worker processes and `--help` start
fast.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin

import msgspec
from msgspec import Meta

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.support import NotNegative, Positive, Share, bind, check_types, did_you_mean, plain

SwarmKind = Literal["joint", "per-drone"]
Clocks = Literal["given", "auto"]

#: Values of `TrackSettings.detections` that are not folders: the detections of the sequence, or blobs of its
#: silhouettes.
YOLO, BLOBS = "yolo", "blobs"

#: Largest speed of a drone where neither the settings nor the data say more, m/s.
USUAL_SPEED_M_S = 6.0

#: Largest numbers of what takes memory and time. Memory for scores grows by half a kilobyte or more per particle and
#: drone; the paper has 100 particles and 70 iterations.
Particles = Annotated[int, Meta(ge=2, le=100_000)]
Iterations = Annotated[int, Meta(ge=0, le=100_000)]
DroneCount = Annotated[int, Meta(ge=1, le=1000)]


def _metavar(values: str) -> Meta:
    """What stands for a setting's values in the help of the command line."""
    return Meta(extra={"metavar": values})


#: The seeds that JAX tells apart: of longer ones it takes the last 32 bits.
Seed = Annotated[int, Meta(ge=0, le=2**32 - 1)]


class _Checked(msgspec.StructMeta):
    """The class of records whose wrong names of fields are answered like wrong options."""

    def __call__(self, *args: Any, **values: Any) -> Any:
        bind(f"{self.__name__}()", inspect.signature(self), args, values)
        return super().__call__(*args, **values)


class _Settings(msgspec.Struct, metaclass=_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the records: all values must have the annotated types, lie in their ranges and be finite.

    Attributes:
        prefix: beginning of the dotted names of the record's settings.
    """

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        check_types(self, self.prefix)
        for field in msgspec.structs.fields(self):
            name, value = f"{self.prefix}{field.name}", plain(getattr(self, field.name))
            choices = get_args(field.type) if get_origin(field.type) is Literal else ()
            if choices and value not in choices:
                raise SettingsError(name, expected=f"one of {', '.join(choices)}", found=value)
            if isinstance(value, list):
                # What Python callers and files give as a list or an array.
                msgspec.structs.force_setattr(self, field.name, tuple(value))
            numbers = value if isinstance(value, list | tuple) else (value,)
            if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
                raise SettingsError(name, expected="finite numbers", found=f"{value}")


class SwarmSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The search for the best positions in one frame: a particle swarm, or another search.

    Attributes:
        search: name of the search: "pso"; "pso-kernel", the same as one kernel per frame, which no GPU has run yet; or
            the name of a plugin.
        kind: "joint", one swarm over the positions of all drones as in the paper, or "per-drone", one for each drone.
        particles: number of particles of every swarm.
        iterations: number of iterations per frame.
        spread_m: standard deviation of the particles' first positions about the predicted position, metres.
        inertia, cognitive, social: coefficients w, c1, c2 of particle swarm optimisation.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "swarm."
    search: Annotated[str, _metavar("pso|pso-kernel|NAME")] = "pso"
    kind: SwarmKind = "per-drone"
    particles: Particles = 30
    iterations: Iterations = 30
    spread_m: Positive = 0.05
    inertia: float = 0.6
    cognitive: float = 1.5
    social: float = 1.5


class ScoreSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The score of positions against silhouettes.

    Attributes:
        kind: name of the score: "soft", concentric windows; "hard", the paper's one box in whole pixels; or the name of
            a plugin.
        windows: scales of a drone's box that the soft score compares with the foreground.
        occlusion: whether foreground that another drone is expected to cover is left out of a drone's score.
        vertex: whether a drone's position is the vertex of a paraboloid through the scores about the best position
            that was tried, not that position itself.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "score."
    kind: Annotated[str, _metavar("soft|hard|NAME")] = "soft"
    windows: Annotated[tuple[Positive, ...], Meta(min_length=1)] = (0.4, 0.7, 1.0)
    occlusion: bool = True
    vertex: bool = True


class MotionSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The motion model of the drones, and how measured positions err (see `psotrack.tracking.motion`).

    Attributes:
        max_speed_m_s: largest speed of a drone, m/s; None: 6 m/s, or more where the data show more.
        jerk_density_m2_s5: spectral density of the white jerk: how quickly drones change their acceleration; None: 1,
            or more for drones that are faster than usual (see `jerk_density`).
        velocity_std_m_s, acceleration_std_m_s2: standard deviations of a new track's velocity and acceleration.
        error_share: share of the measured positions' variance that lasts from frame to frame, because what silhouettes
            show of a drone changes only as the drone turns.
        error_time_s: time constant of these correlated errors, seconds.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "motion."
    max_speed_m_s: Positive | None = None
    jerk_density_m2_s5: Positive | None = None
    velocity_std_m_s: Positive = 1.0
    acceleration_std_m_s2: Positive = 3.0
    error_share: Share = 0.7
    error_time_s: Positive = 0.4

    @property
    def speed_limit_m_s(self) -> float:
        """Largest speed of a drone, m/s: `max_speed_m_s`, or `USUAL_SPEED_M_S`."""
        return USUAL_SPEED_M_S if self.max_speed_m_s is None else self.max_speed_m_s

    @property
    def jerk_density(self) -> float:
        """Spectral density of the white jerk, m²/s⁵: `jerk_density_m2_s5`, or what fits the speed limit.

        Faster drones turn harder. On circles of one size the density grows with the fifth power of the speed; but fast
        drones fly wider circles. The third power tracks best, in a wide optimum.
        """
        if self.jerk_density_m2_s5 is not None:
            return self.jerk_density_m2_s5
        return max(1.0, (self.speed_limit_m_s / USUAL_SPEED_M_S) ** 3)


class DroneSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is known of the drones beforehand.

    Attributes:
        count: number of drones; None: all drones that are found.
        size_m: full lengths of every drone along x, y and z, metres; None: estimated while tracking.
        learn_sizes: whether sizes are learned while tracking; `size_m` switches this off.
        body_offset_m: vector from the body's origin to the middle of the silhouette (with "projection-lines" of the
            box), along the world's axes, metres. No image shows where the origin is.
        origin_uncertainty_m: standard deviation of `body_offset_m` along each axis, metres; None: the covariance is
            that of the middle, not of the origin.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "drones."
    count: DroneCount | None = None
    size_m: Annotated[tuple[Positive, Positive, Positive], _metavar("X,Y,Z")] | None = None
    learn_sizes: bool = True
    body_offset_m: Annotated[tuple[float, float, float], _metavar("X,Y,Z")] = (0.0, 0.0, 0.0)
    origin_uncertainty_m: NotNegative | None = None


class StatusSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a drone counts as found in a frame, and when it is lost.

    Attributes:
        min_fitness: smallest fitness of a drone that counts as found.
        min_cameras: smallest number of cameras that see a drone that counts as found, by foreground or by detections.
        min_cameras_to_begin: number of cameras, at different places, that must agree to begin a track. Two that agree
            for long are enough for the projection lines also where a third should see the drone: something may hide
            the drone. None: three where at least three cameras have the place in view, else two.
        max_coasting_s: seconds for which a drone that is not found coasts on its prediction before it is lost.
        max_coasting_std_m: largest standard deviation, along the worst axis, of a position that the projection lines
            state for a drone that is not found, metres; a drone seen by one camera alone may coast for long.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "status."
    min_fitness: Share = 0.1
    min_cameras: Annotated[int, Meta(ge=1)] = 2
    min_cameras_to_begin: Annotated[int, Meta(ge=2)] | None = None
    max_coasting_s: NotNegative = 0.5
    max_coasting_std_m: Positive = 0.5


class IdentitySettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which drones may have been taken for each other, and what to do about it.

    Attributes:
        encounter_m: drones nearer than this to each other may be taken for each other, metres.
        resolve_swaps: whether labels that were exchanged in an encounter are put right.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "identity."
    encounter_m: NotNegative = 0.6
    resolve_swaps: bool = True


class ErrorSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is known of the cameras' errors beforehand; what the cameras show counts if it is more.

    Attributes:
        rig_deg: angle by which each camera is turned about a random axis, degrees.
        pixel_px: standard deviation, along either axis, of the error of a drone's place in a camera's image that lasts
            for as long as the drone stays in one part of the image, pixels.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "errors."
    rig_deg: NotNegative = 0.0
    pixel_px: NotNegative = 0.0


class TrackSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a sequence is tracked.

    Attributes:
        method: "swarm", particles over silhouettes; "projection-lines", triangulated detections; "fused", both,
            weighted by their covariances; or the name of a plugin.
        detections: source of the detections of the projection lines: "yolo", the detections that came with the
            sequence; "blobs", the blobs of its silhouettes; or a folder with a CSV file for each camera.
        seed: seed of the swarm's random numbers.
        init: initial state: "auto" finds the drones in the first frames, "truth" takes them from the reference; or the
            name of a file of tracks, whose first frame is used.
        bounds_m: lowest and highest x, y and z of the room, metres: (x0, x1, y0, y1, z0, z1); None: derived from the
            cameras and from what moves.
        smooth: whether later frames correct earlier ones.
        rate_hz: instants per second at which drones are tracked; None: the rate of the fastest camera.
        clocks: times of the cameras' frames: "given", those of the recording; or "auto", those corrected by each
            camera's offset and drift, which are estimated from the motion of the drones. This takes a second pass.
        swarm: the search in one frame.
        score: the score of positions.
        motion: the motion model.
        drones: number and sizes of the drones.
        status: when a drone is found or lost.
        identity: encounters of drones.
        errors: errors of the cameras that are known beforehand.
        silhouettes: how silhouettes are made.

    Raises:
        SettingsError: a value is not allowed.
    """

    method: Annotated[str, _metavar("swarm|projection-lines|fused|NAME")] = "swarm"
    detections: Annotated[str, _metavar("yolo|blobs|FOLDER")] = YOLO
    seed: Seed = 0
    init: Annotated[str, _metavar("auto|truth|FILE")] = "auto"
    bounds_m: (
        Annotated[tuple[float, float, float, float, float, float], _metavar("X0,X1,Y0,Y1,Z0,Z1")] | None
    ) = None
    smooth: bool = False
    rate_hz: Positive | None = None
    clocks: Clocks = "given"
    swarm: SwarmSettings = SwarmSettings()
    score: ScoreSettings = ScoreSettings()
    motion: MotionSettings = MotionSettings()
    drones: DroneSettings = DroneSettings()
    status: StatusSettings = StatusSettings()
    identity: IdentitySettings = IdentitySettings()
    errors: ErrorSettings = ErrorSettings()
    silhouettes: SilhouetteSettings = SilhouetteSettings()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bounds_m is not None and any(
            low >= high for low, high in zip(self.bounds_m[::2], self.bounds_m[1::2], strict=True)
        ):
            raise SettingsError("bounds_m", expected="x0 < x1, y0 < y1, z0 < z1", found=f"{self.bounds_m}")

    @property
    def needs_silhouettes(self) -> bool:
        """Whether a run with these settings needs silhouettes."""
        return self.method != "projection-lines" or self.detections == BLOBS

    @property
    def needs_each_video(self) -> bool:
        """Whether a camera needs a video: "fused" uses a camera that has detections only for its detections."""
        return self.needs_silhouettes and not (self.method == "fused" and self.reads_detections)

    @property
    def reads_detections(self) -> bool:
        """Whether a run with these settings reads files of detections."""
        return self.method in ("projection-lines", "fused") and self.detections != BLOBS

    def changed(self, values: Mapping[str, Any]) -> TrackSettings:
        """These settings with other values.

        Args:
            values: dotted names -> values, such as {"swarm.particles": 50}.

        Raises:
            SettingsError: a name is unknown, or a value is not allowed.

        >>> TrackSettings().changed({"swarm.particles": 50, "smooth": True}).swarm.particles
        50
        """
        parts: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            if name not in setting_names():
                raise _unknown(name)
            part, _, field = name.rpartition(".")
            parts.setdefault(part, {})[field] = plain(value)
        own = parts.pop("", {})
        for part, fields in parts.items():
            own[part] = msgspec.structs.replace(getattr(self, part), **fields)
        return msgspec.structs.replace(self, **own)


def setting_names() -> tuple[str, ...]:
    """Dotted names of all settings, such as `seed`, `swarm.particles`, `silhouettes.reduction`."""
    return tuple(dict(flatten(msgspec.to_builtins(TrackSettings()))))


def full_name(name: str) -> str:
    """The dotted name of a setting that is named by its last part, such as `swarm.particles` by `particles`.

    Raises:
        SettingsError: no setting has the name, or several have it.
    """
    if name in setting_names():
        return name
    found = [other for other in setting_names() if other.rpartition(".")[2] == name]
    if len(found) > 1:
        remedy = f"pass it in a dict as second argument, such as {{{found[0]!r}: ...}}"
        raise SettingsError(name, expected=f"one of {', '.join(found)}", found=name, remedy=remedy)
    if not found:
        raise _unknown(name)
    return found[0]


def _unknown(name: str) -> SettingsError:
    remedy = did_you_mean(name, setting_names())
    return SettingsError(name, expected="the name of a setting", found=name, remedy=remedy)


def flatten(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of a nested table; an empty inner table is a value."""
    for name, value in content.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value

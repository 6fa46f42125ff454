"""Settings of tracking: one checked record, the same for the command line, sweeps and Python.

Defaults stand here and nowhere else. The record is nested by part: a name such as `swarm.particles` is the same in TOML
files, in sweeps and as attributes. Importing this module loads no JAX, so that worker processes and `--help` start
fast.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar, Literal, get_args

import msgspec

from psotrack.errors import SettingsError, check_positive
from psotrack.silhouettes import SilhouetteSettings
from psotrack.support import check_types, nearest, plain

SwarmKind = Literal["joint", "per-drone"]
Clocks = Literal["given", "auto"]

#: Values of `TrackSettings.detections` that are not folders: the detections of the sequence, or blobs of its
#: silhouettes.
YOLO, BLOBS = "yolo", "blobs"

#: Largest speed of a drone where neither the settings nor the data say more, m/s.
USUAL_SPEED_M_S = 6.0

#: Names of settings until version 0.1, and their names today; "" where a setting is gone.
RENAMED = {
    "particles": "swarm.particles",
    "iterations": "swarm.iterations",
    "refinements": "",
    "swarm": "swarm.kind",
    "spread_m": "swarm.spread_m",
    "inertia": "swarm.inertia",
    "cognitive": "swarm.cognitive",
    "social": "swarm.social",
    "score": "score.kind",
    "windows": "score.windows",
    "claims": "score.occlusion",
    "vertex": "score.vertex",
    "drones": "drones.count",
    "drone_size_m": "drones.size_m",
    "learn_sizes": "drones.learn_sizes",
    "body_offset_m": "drones.body_offset_m",
    "max_speed_m_s": "motion.max_speed_m_s",
    "jerk_density_m2_s5": "motion.jerk_density_m2_s5",
    "velocity_std_m_s": "motion.velocity_std_m_s",
    "acceleration_std_m_s2": "motion.acceleration_std_m_s2",
    "error_share": "motion.error_share",
    "error_time_s": "motion.error_time_s",
    "min_fitness": "status.min_fitness",
    "min_cameras": "status.min_cameras",
    "max_coasting_s": "status.max_coasting_s",
    "encounter_m": "identity.encounter_m",
    "mend": "identity.resolve_swaps",
}


def renamed(name: str) -> str:
    """What to do about a setting's old name, as the remedy of an error message; "" where the name is no old name."""
    if name not in RENAMED:
        return ""
    return (
        f"it is called {RENAMED[name]} today" if RENAMED[name] else "this setting is gone: it gained nothing"
    )


#: Largest numbers of what takes memory and time. Memory for scores grows by half a kilobyte or more per particle and
#: drone; the paper has 100 particles and 70 iterations.
_MOST_PARTICLES, _MOST_ITERATIONS, _MOST_DRONES = 100_000, 100_000, 1000
#: Largest seed of JAX and NumPy.
_MOST_SEED = 2**63 - 1


def _check_count(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise SettingsError(name, expected=f"a number from {least} to {most}", found=f"{value}")


def _check_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise SettingsError(name, expected=f"at least {least}", found=f"{value}")


def _check_finite(name: str, values: Iterable[float]) -> None:
    if not all(map(math.isfinite, values)):
        raise SettingsError(name, expected="finite numbers", found=f"{values}")


def _check_range(name: str, value: float | int, low: float, high: float = float("inf")) -> None:
    """Raise `SettingsError` unless low <= value <= high and the value is finite."""
    if not (low <= value <= high and value < float("inf")):
        expected = (
            f"a number from {low:g} to {high:g}" if high < float("inf") else f"a number of at least {low:g}"
        )
        raise SettingsError(name, expected=expected, found=f"{value:g}")


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise SettingsError(name, expected=f"one of {', '.join(choices)}", found=value)


class _AnswersOldNames(msgspec.StructMeta):
    """Answers old names of settings with the new ones, where a record is made in Python."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:  # noqa: N805
        for name, value in kwargs.items():
            # `swarm`, `score` and `drones` are parts today; their old values were no records.
            is_part = name in cls.__struct_fields__
            if name in RENAMED and not (is_part and isinstance(value, msgspec.Struct)):
                raise SettingsError(
                    name,
                    expected="a part of the settings" if is_part else "the name of a setting",
                    found=f"{value!r}" if is_part else name,
                    remedy=renamed(name),
                )
        return super().__call__(*args, **kwargs)


class _Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the records: the types of all values are checked.

    Attributes:
        prefix: beginning of the dotted names of the record's settings.
    """

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        check_types(self, self.prefix)


class SwarmSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The search for the best positions in one frame: a particle swarm, or another search.

    Attributes:
        search: name of the search: "pso", or the name of a plugin.
        kind: "joint", one swarm over the positions of all drones as in the paper, or "per-drone", one for each drone.
        particles: number of particles of every swarm.
        iterations: number of iterations per frame.
        spread_m: standard deviation of the particles' first positions about the predicted position, metres.
        inertia, cognitive, social: coefficients w, c1, c2 of particle swarm optimisation.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "swarm."
    search: str = "pso"
    kind: SwarmKind = "per-drone"
    particles: int = 30
    iterations: int = 30
    spread_m: float = 0.05
    inertia: float = 0.6
    cognitive: float = 1.5
    social: float = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_choice("swarm.kind", self.kind, get_args(SwarmKind))
        _check_count("swarm.particles", self.particles, 2, _MOST_PARTICLES)
        _check_count("swarm.iterations", self.iterations, 0, _MOST_ITERATIONS)
        check_positive("swarm.spread_m", self.spread_m)


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
    kind: str = "soft"
    windows: tuple[float, ...] = (0.4, 0.7, 1.0)
    occlusion: bool = True
    vertex: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.windows:
            raise SettingsError("score.windows", expected="at least one scale", found="none")
        for scale in self.windows:
            check_positive("score.windows", scale)


class MotionSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The motion model of the drones, and how measured positions err (see `psotrack.motion`).

    Attributes:
        max_speed_m_s: largest speed of a drone, m/s; None: 6 m/s, or more where the data show more.
        jerk_density_m2_s5: spectral density of the white jerk: how quickly drones change their acceleration; None: 1,
            or more for drones that are faster than usual (see `jerk_density`).
        velocity_std_m_s, acceleration_std_m_s2: standard deviations of a new track's velocity and acceleration.
        error_share: share of the measured positions' variance that lasts from frame to frame, because what silhouettes
            show of a drone changes only as the drone turns.
        error_time_s: time constant of these lasting errors, seconds.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "motion."
    max_speed_m_s: float | None = None
    jerk_density_m2_s5: float | None = None
    velocity_std_m_s: float = 1.0
    acceleration_std_m_s2: float = 3.0
    error_share: float = 0.7
    error_time_s: float = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (
            "max_speed_m_s",
            "jerk_density_m2_s5",
            "velocity_std_m_s",
            "acceleration_std_m_s2",
            "error_time_s",
        ):
            if getattr(self, name) is not None:
                check_positive(f"motion.{name}", getattr(self, name))
        _check_range("motion.error_share", self.error_share, 0.0, 1.0)

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
        count: number of drones; None takes all drones that are found.
        size_m: full lengths of every drone along x, y and z, metres; None takes them from the first frames.
        learn_sizes: whether sizes are learned while tracking; `size_m` switches this off.
        body_offset_m: vector from the body's origin to the middle of the silhouette (with "projection-lines" of the
            box), along the world's axes, metres. No image shows where the origin is.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "drones."
    count: int | None = None
    size_m: tuple[float, float, float] | None = None
    learn_sizes: bool = True
    body_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.count is not None:
            _check_count("drones.count", self.count, 1, _MOST_DRONES)
        for length_m in self.size_m or ():
            check_positive("drones.size_m", length_m)
        _check_finite("drones.body_offset_m", self.body_offset_m)


class StatusSettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a drone counts as found in a frame, and when it is lost.

    Attributes:
        min_fitness: smallest fitness of a drone that counts as found.
        min_cameras: smallest number of cameras that see a drone that counts as found, by foreground or by detections.
        min_cameras_to_begin: number of cameras, at different places, that must agree to begin a track; None: three
            where at least three cameras have the place in view, else two. Two that agree for long are enough for the
            projection lines also where a third should see the drone: something may hide the drone.
        max_coasting_s: seconds for which a drone that is not found coasts on its prediction before it is lost.
        max_coasting_std_m: largest standard deviation, along the worst axis, of a position that the projection lines
            state for a drone that is not found, metres; a drone seen by one camera alone may coast for long.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "status."
    min_fitness: float = 0.1
    min_cameras: int = 2
    min_cameras_to_begin: int | None = None
    max_coasting_s: float = 0.5
    max_coasting_std_m: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_least("status.min_cameras", self.min_cameras, 1)
        if self.min_cameras_to_begin is not None:
            _check_least("status.min_cameras_to_begin", self.min_cameras_to_begin, 2)
        _check_range("status.min_fitness", self.min_fitness, 0.0, 1.0)
        _check_range("status.max_coasting_s", self.max_coasting_s, 0.0)
        check_positive("status.max_coasting_std_m", self.max_coasting_std_m)


class IdentitySettings(_Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which drones may have been taken for each other, and what to do about it.

    Attributes:
        encounter_m: drones nearer than this to each other may be taken for each other, metres.
        resolve_swaps: whether labels that were exchanged in an encounter are put right.

    Raises:
        SettingsError: a value is not allowed.
    """

    prefix: ClassVar[str] = "identity."
    encounter_m: float = 0.6
    resolve_swaps: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_range("identity.encounter_m", self.encounter_m, 0.0)


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
    rig_deg: float = 0.0
    pixel_px: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rig_deg", "pixel_px"):
            _check_range(f"errors.{name}", getattr(self, name), 0.0)


class TrackSettings(
    _Settings, frozen=True, kw_only=True, forbid_unknown_fields=True, metaclass=_AnswersOldNames
):
    """How a sequence is tracked.

    Attributes:
        method: "swarm", particles over silhouettes; "projection-lines", triangulated detections; "fused", both,
            weighted by their covariances; or the name of a plugin.
        detections: source of the detections of the projection lines: "yolo", the detections that came with the
            sequence; "blobs", the blobs of its silhouettes; or a folder with a CSV file for each camera.
        seed: seed of the swarm's random numbers.
        init: initial state: "auto" finds the drones in the first frames, "truth" takes them from the reference; or the
            name of a file of tracks, whose first frame is used.
        bounds_m: lowest and highest x, y and z of the room, metres: (x0, x1, y0, y1, z0, z1); None derives them from
            the cameras.
        smooth: whether later frames correct earlier ones.
        rate_hz: instants per second at which drones are tracked; None is the rate of the fastest camera.
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
        SettingsError: a value is not allowed, or a name is an old one.
    """

    method: str = "swarm"
    detections: str = YOLO
    seed: int = 0
    init: str = "auto"
    bounds_m: tuple[float, float, float, float, float, float] | None = None
    smooth: bool = False
    rate_hz: float | None = None
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
        _check_count("seed", self.seed, 0, _MOST_SEED)
        _check_choice("clocks", self.clocks, get_args(Clocks))
        if self.rate_hz is not None:
            check_positive("rate_hz", self.rate_hz)
        if self.bounds_m is not None:
            _check_finite("bounds_m", self.bounds_m)
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
            SettingsError: a name is unknown or old, or a value is not allowed.

        >>> TrackSettings().changed({"swarm.particles": 50, "smooth": True}).swarm.particles
        50
        """
        parts: dict[str, dict[str, Any]] = {}
        own: dict[str, Any] = {}
        for name, value in values.items():
            if name not in setting_names():
                near = nearest(name, setting_names())
                remedy = renamed(name) or (f"did you mean {near}?" if near else "")
                raise SettingsError(name, expected="the name of a setting", found=name, remedy=remedy)
            value = plain(value)
            part, dot, field = name.partition(".")
            if dot:
                parts.setdefault(part, {})[field] = value
            else:
                own[name] = value
        for part, fields in parts.items():
            own[part] = msgspec.structs.replace(getattr(self, part), **fields)
        return msgspec.structs.replace(self, **own)


def setting_names() -> tuple[str, ...]:
    """Dotted names of all settings, such as `seed`, `swarm.particles`, `silhouettes.reduction`."""
    return tuple(_names_in(TrackSettings()))


def _names_in(record: msgspec.Struct, prefix: str = "") -> Iterator[str]:
    for name in record.__struct_fields__:
        value = getattr(record, name)
        if isinstance(value, msgspec.Struct):
            yield from _names_in(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"

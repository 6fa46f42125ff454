"""What people set: one checked record, the same for the command line, sweeps and notebooks.

Defaults are written here and nowhere else. Importing this is cheap: no JAX, so that workers and `--help` start fast.
"""

from __future__ import annotations

from typing import Literal, get_args

import msgspec

from psotrack.errors import SettingsError, check_positive
from psotrack.silhouettes import SilhouetteSettings

SwarmKind = Literal["joint", "per-drone"]
Score = Literal["soft", "hard"]
Method = Literal["swarm", "projection-lines", "fused"]
#: Detections that need no folder: the sequence's own, or blobs of its silhouettes.
YOLO, BLOBS = "yolo", "blobs"


class TrackSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a sequence is tracked.

    Attributes:
        method: "swarm", of particles over silhouettes; "projection-lines", which triangulates detections; or "fused",
            both, weighed by how sure they are.
        detections: of the projection lines: "yolo", those that came with the sequence; "blobs" of its silhouettes; or a
            folder with a CSV file for each camera.
        particles: of every swarm.
        iterations: of the swarm, per frame.
        refinements: gradient steps after the swarm, per frame.
        swarm: "joint", one swarm over all drones as in the paper, or "per-drone".
        score: "soft", concentric windows; or "hard", the paper's one box in whole pixels.
        seed: of the swarm.
        init: "auto" finds the drones in the first frames, "truth" takes them from the reference; or a file of
            tracks, whose first frame counts.
        drones: how many there are; None takes as many as `init` yields.
        drone_size_m: full lengths of every drone along x, y and z; None takes them from the first frames.
        learn_sizes: whether sizes are learned on the way; not where `drone_size_m` says them.
        body_offset_m: from the body's origin to the middle of the silhouette (with "projection-lines" of the box),
            along the world's axes. Neither shows where the origin is; who knows it may say.
        bounds_m: lowest and highest x, y and z of the room: (x0, x1, y0, y1, z0, z1); None derives them from the
            cameras.
        max_speed_m_s: of a drone.
        spread_m: standard deviation of the particles about the prediction.
        inertia, cognitive, social: of the swarm.
        jerk_density_m2_s5: of the motion model: how quickly drones change their acceleration (see `motion`).
        velocity_std_m_s, acceleration_std_m_s2: how uncertain a start is of them.
        error_share, error_time_s: share of the measured positions' variance that lasts from frame to frame, and how
            long: what silhouettes show of a drone changes as it turns.
        min_fitness: below it a drone was not found.
        min_cameras: fewer than these, and a drone was not found.
        max_coasting_s: so long a drone that is not found coasts before it is lost.
        windows: scales of a drone's box that the soft score compares with the foreground.
        claims: whether foreground that another drone is expected to cover is left out of a drone's score.
        vertex: whether a drone is where a paraboloid through the score has its vertex, not just the best place tried.
        encounter_m: drones nearer than this to each other may be taken for each other.
        mend: whether labels that were exchanged in an encounter are put right.
        smooth: whether later frames correct earlier ones.
        silhouettes: how they are made.

    Raises:
        SettingsError: a value makes no sense.
    """

    method: Method = "swarm"
    detections: str = YOLO
    particles: int = 30
    iterations: int = 30
    refinements: int = 0
    swarm: SwarmKind = "per-drone"
    score: Score = "soft"
    seed: int = 0
    init: str = "auto"
    drones: int | None = None
    drone_size_m: tuple[float, float, float] | None = None
    learn_sizes: bool = True
    body_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bounds_m: tuple[float, float, float, float, float, float] | None = None
    max_speed_m_s: float = 6.0
    spread_m: float = 0.05
    inertia: float = 0.6
    cognitive: float = 1.5
    social: float = 1.5
    jerk_density_m2_s5: float = 1.0
    velocity_std_m_s: float = 1.0
    acceleration_std_m_s2: float = 3.0
    error_share: float = 0.7
    error_time_s: float = 0.4
    min_fitness: float = 0.1
    min_cameras: int = 2
    max_coasting_s: float = 0.5
    windows: tuple[float, ...] = (0.4, 0.7, 1.0)
    claims: bool = True
    vertex: bool = True
    encounter_m: float = 0.6
    mend: bool = True
    smooth: bool = False
    silhouettes: SilhouetteSettings = SilhouetteSettings()

    def __post_init__(self) -> None:
        for name, least in (
            ("particles", 2),
            ("iterations", 0),
            ("refinements", 0),
            ("min_cameras", 1),
            ("seed", 0),
        ):
            if getattr(self, name) < least:
                raise SettingsError(name, expected=f"at least {least}", found=f"{getattr(self, name)}")
        if self.drones is not None and self.drones < 1:
            raise SettingsError("drones", expected="at least 1", found=f"{self.drones}")
        for name in (
            "max_speed_m_s",
            "spread_m",
            "jerk_density_m2_s5",
            "velocity_std_m_s",
            "acceleration_std_m_s2",
            "error_time_s",
        ):
            check_positive(name, getattr(self, name))
        for size in self.drone_size_m or ():
            check_positive("drone_size_m", size)
        for name, words in (
            ("method", get_args(Method)),
            ("swarm", get_args(SwarmKind)),
            ("score", get_args(Score)),
        ):
            if getattr(self, name) not in words:
                raise SettingsError(name, expected=f"one of {', '.join(words)}", found=getattr(self, name))
        if self.bounds_m is not None and any(
            low >= high for low, high in zip(self.bounds_m[::2], self.bounds_m[1::2], strict=True)
        ):
            raise SettingsError("bounds_m", expected="x0 < x1, y0 < y1, z0 < z1", found=f"{self.bounds_m}")

    @property
    def needs_silhouettes(self) -> bool:
        """Whether silhouettes are read."""
        return self.method != "projection-lines" or self.detections == BLOBS

    @property
    def reads_detections(self) -> bool:
        """Whether files of detections are read."""
        return self.method != "swarm" and self.detections != BLOBS

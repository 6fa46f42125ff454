"""What people set: one checked record, the same for the command line, sweeps and notebooks.

Defaults are written here and nowhere else. Importing this is cheap: no JAX, so that workers and `--help` start fast.
"""

from __future__ import annotations

from typing import Literal, get_args

import msgspec

from psotrack.errors import SettingsError, check_positive
from psotrack.silhouette_store import SilhouetteSettings

SwarmKind = Literal["joint", "per-drone"]
Score = Literal["soft", "hard"]


class TrackSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a sequence is tracked.

    Attributes:
        particles: of every swarm.
        iterations: of the swarm, per frame.
        swarm: "joint", one swarm over all drones as in the paper, or "per-drone".
        score: "soft", concentric windows; or "hard", the paper's one box in whole pixels.
        seed: of the swarm.
        init: "auto" finds the drones in the first frames, "truth" takes them from the reference; or a file of
            tracks, whose first frame counts.
        drones: how many there are; None takes as many as `init` yields.
        drone_size_m: full lengths of every drone along x, y and z; None takes them from the first frames.
        bounds_m: lowest and highest x, y and z of the room: (x0, x1, y0, y1, z0, z1); None derives them from the
            cameras.
        max_speed_m_s: of a drone.
        spread_m: standard deviation of the particles about the prediction.
        inertia, cognitive, social: of the swarm.
        position_gain, velocity_gain: of the motion model.
        min_fitness: below it a drone was not found.
        min_cameras: fewer than these, and a drone was not found.
        max_coasting_s: so long a drone that is not found coasts before it is lost.
        silhouettes: how they are made.

    Raises:
        SettingsError: a value makes no sense.
    """

    particles: int = 30
    iterations: int = 30
    swarm: SwarmKind = "per-drone"
    score: Score = "soft"
    seed: int = 0
    init: str = "auto"
    drones: int | None = None
    drone_size_m: tuple[float, float, float] | None = None
    bounds_m: tuple[float, float, float, float, float, float] | None = None
    max_speed_m_s: float = 6.0
    spread_m: float = 0.05
    inertia: float = 0.6
    cognitive: float = 1.5
    social: float = 1.5
    position_gain: float = 0.8
    velocity_gain: float = 0.3
    min_fitness: float = 0.1
    min_cameras: int = 2
    max_coasting_s: float = 0.5
    silhouettes: SilhouetteSettings = SilhouetteSettings()

    def __post_init__(self) -> None:
        for name, least in (("particles", 2), ("iterations", 0), ("min_cameras", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise SettingsError(name, expected=f"at least {least}", found=f"{getattr(self, name)}")
        if self.drones is not None and self.drones < 1:
            raise SettingsError("drones", expected="at least 1", found=f"{self.drones}")
        for name in ("max_speed_m_s", "spread_m"):
            check_positive(name, getattr(self, name))
        for size in self.drone_size_m or ():
            check_positive("drone_size_m", size)
        for name, words in (("swarm", get_args(SwarmKind)), ("score", get_args(Score))):
            if getattr(self, name) not in words:
                raise SettingsError(name, expected=f"one of {', '.join(words)}", found=getattr(self, name))
        if self.bounds_m is not None and any(
            low >= high for low, high in zip(self.bounds_m[::2], self.bounds_m[1::2], strict=True)
        ):
            raise SettingsError("bounds_m", expected="x0 < x1, y0 < y1, z0 < z1", found=f"{self.bounds_m}")

"""Scenarios: small declarative records of who flies where, how, and before which cameras. Data, not code."""

from __future__ import annotations

import msgspec

from psotrack.errors import SettingsError

Vector = tuple[float, float, float]


class Harmonic(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One term of a flight: `amplitude_m * sin(2 pi t / period_s + phase_deg)` along each axis."""

    amplitude_m: Vector
    period_s: float
    phase_deg: Vector


class Drone(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A drone: its model, its paint, and its flight as a sum of harmonics about a centre.

    Attributes:
        model: a name in `psotrack.simulation.drones.MODELS`.
        paint_bgr: reflectance of its paint, linear, 0 to 1 (dark grey is 0.1).
        centre_m: what the flight goes around, world.
        harmonics: the flight.
        yaw_deg, yaw_sway_deg, yaw_period_s: heading, and how far and how slowly it turns to and fro.
    """

    model: str
    paint_bgr: Vector
    centre_m: Vector
    harmonics: tuple[Harmonic, ...]
    yaw_deg: float = 0.0
    yaw_sway_deg: float = 40.0
    yaw_period_s: float = 9.0


class CameraPlace(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a camera hangs and looks, with intrinsics at full size."""

    position_m: Vector
    target_m: Vector
    focal_length_px: float = 1156.3
    principal_point_px: tuple[float, float] = (960.0, 540.0)


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every flight of a scenario keeps to, whatever the seed."""

    max_speed_m_s: float
    max_acceleration_m_s2: float
    max_tilt_deg: float
    min_distance_m: float
    lower_m: Vector
    upper_m: Vector


class Scenario(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One sequence to simulate.

    Attributes:
        room: a name in `psotrack.simulation.rooms.HALLS`.
        markers: whether ArUco markers hang on the walls (the `_A` sequences).
        shutter_s: exposure time, which blurs what moves.
        variation_deg, variation_m: how far a seed moves the phases and the centres of flights.
    """

    name: str
    room: str
    markers: bool
    num_frames: int
    cameras: tuple[CameraPlace, ...]
    drones: tuple[Drone, ...]
    limits: Limits
    fps: float = 25.0
    image_size_wh: tuple[int, int] = (1920, 1080)
    shutter_s: float = 1 / 125
    variation_deg: float = 25.0
    variation_m: float = 0.15


#: Four in the corners; cam5 and cam6 2 cm apart; cam7 and cam8 both near x = 0 (as the paper places them).
LABORATORY_CAMERAS = (
    CameraPlace(position_m=(-4.7, -3.7, 3.1), target_m=(0.1, 0.0, 1.25)),
    CameraPlace(position_m=(4.7, -3.7, 3.0), target_m=(0.0, 0.1, 1.3)),
    CameraPlace(position_m=(4.7, 3.7, 3.05), target_m=(-0.1, 0.0, 1.25)),
    CameraPlace(position_m=(-4.7, 3.7, 3.0), target_m=(0.0, -0.1, 1.3)),
    CameraPlace(position_m=(-4.8, 0.30, 2.9), target_m=(0.0, 0.0, 1.3)),
    CameraPlace(position_m=(-4.8, 0.32, 2.9), target_m=(0.0, -0.15, 1.35)),
    CameraPlace(position_m=(0.10, 3.85, 3.0), target_m=(0.0, 0.0, 1.35)),
    CameraPlace(position_m=(-0.05, -3.85, 2.95), target_m=(0.1, 0.0, 1.4)),
)

_S02 = Scenario(
    name="S02_D4_A",
    room="laboratory",
    markers=True,
    num_frames=250,
    cameras=LABORATORY_CAMERAS,
    limits=Limits(
        max_speed_m_s=2.6,
        max_acceleration_m_s2=3.5,
        max_tilt_deg=20.0,
        min_distance_m=0.8,
        lower_m=(-2.7, -1.9, 0.7),
        upper_m=(2.7, 1.9, 2.4),
    ),
    drones=(
        # Two on one orbit, a half turn apart; one that crosses it to and fro; one on a figure of eight.
        Drone(
            model="x_frame",
            paint_bgr=(0.028, 0.025, 0.025),
            centre_m=(0.0, 0.0, 1.85),
            harmonics=(
                Harmonic(amplitude_m=(1.9, 1.35, 0.0), period_s=7.4, phase_deg=(90.0, 0.0, 0.0)),
                Harmonic(amplitude_m=(0.0, 0.1, 0.25), period_s=4.1, phase_deg=(0.0, 90.0, 60.0)),
            ),
        ),
        Drone(
            model="camera_drone",
            paint_bgr=(0.32, 0.30, 0.28),
            centre_m=(0.0, 0.0, 1.8),
            harmonics=(
                Harmonic(amplitude_m=(2.0, 1.3, 0.0), period_s=7.4, phase_deg=(270.0, 180.0, 0.0)),
                Harmonic(amplitude_m=(0.1, 0.0, 0.2), period_s=5.3, phase_deg=(320.0, 0.0, 140.0)),
            ),
            yaw_deg=120.0,
        ),
        Drone(
            model="tall_cross",
            paint_bgr=(0.075, 0.045, 0.035),
            centre_m=(-0.2, 0.0, 1.05),
            harmonics=(
                Harmonic(amplitude_m=(0.35, 1.45, 0.0), period_s=5.54, phase_deg=(160.0, 90.0, 0.0)),
                Harmonic(amplitude_m=(0.5, 0.0, 0.15), period_s=8.6, phase_deg=(170.0, 0.0, 310.0)),
            ),
            yaw_deg=30.0,
        ),
        Drone(
            model="x_frame",
            paint_bgr=(0.035, 0.04, 0.10),
            centre_m=(0.2, 0.0, 1.1),
            harmonics=(
                Harmonic(amplitude_m=(2.1, 0.0, 0.15), period_s=9.3, phase_deg=(70.0, 0.0, 210.0)),
                Harmonic(amplitude_m=(0.0, 1.0, 0.1), period_s=4.65, phase_deg=(0.0, 150.0, 340.0)),
            ),
            yaw_deg=210.0,
        ),
    ),
)

SCENARIOS = {scenario.name: scenario for scenario in (_S02,)}


def scenario(name: str) -> Scenario:
    """The scenario of that name.

    Raises:
        SettingsError: there is none; the message lists those there are.
    """
    if name not in SCENARIOS:
        raise SettingsError("scenario", expected=f"one of {', '.join(SCENARIOS)}", found=name)
    return SCENARIOS[name]

"""The five drone models of the package, and the model of a scenario's drone.

Body frame: x ahead, y left, z up, metres; the origin is the middle of the frame plate, where a flight controller
sits. It is not the middle of the silhouette: bodies and legs reach further down or up, as on real drones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError
from psotrack.simulation.scenarios import Mesh
from psotrack.simulation.world.meshes import load
from psotrack.simulation.world.models import DroneModel as DroneModel
from psotrack.simulation.world.models import Triangles, beam, box, cylinder, pitch, turn
from psotrack.simulation.world.models import disc_fans as disc_fans
from psotrack.simulation.world.models import marker_cross as marker_cross


def model(name: str | Mesh) -> DroneModel:
    """Drone model with a given name, or from a mesh.

    Raises:
        SettingsError: no model has this name; the message lists the names.
        InputError: the mesh cannot be used.
    """
    if isinstance(name, Mesh):
        return load(name)
    if name not in MODELS:
        raise SettingsError("drone model", expected=f"one of {', '.join(MODELS)}, or a mesh", found=name)
    return MODELS[name]()


def _assembled(
    parts: list[tuple[Triangles, float]], motors: Float[np.ndarray, "rotors 3"], rotor_radius_m: float
) -> DroneModel:
    for x, y, z in motors:
        parts.append((cylinder((x, y, z), 0.014, 0.026), 0.1))
        parts.append((cylinder((x, y, z + 0.017), 0.006, 0.010, sides=6), 0.0))
    triangles = np.concatenate([triangles for triangles, _ in parts])
    paint = np.concatenate([np.full(len(triangles), share) for triangles, share in parts])
    return DroneModel(
        triangles, paint, motors + np.array([0.0, 0.0, 0.020]), np.full(len(motors), rotor_radius_m)
    )


def _ring(radius: float, angles_deg: tuple[float, ...], z: float) -> Float[np.ndarray, "rotors 3"]:
    angles = np.radians(angles_deg)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), z)], axis=-1)


def x_frame() -> DroneModel:
    """Carbon X frame with its battery on top: 0.34 m from motor to motor, 0.39 m long along x."""
    arms = (45.0, 135.0, 225.0, 315.0)
    motors = _ring(0.17, arms, 0.012)
    parts = [
        (box((0.0, 0.0, 0.0), (0.15, 0.075, 0.012)), 1.0),
        (box((0.0, 0.0, 0.032), (0.13, 0.06, 0.006)), 1.0),
        (box((0.0, 0.0, 0.016), (0.06, 0.045, 0.026)), 0.3),
        (box((-0.005, 0.0, 0.053), (0.10, 0.042, 0.034), 0.92), 0.6),
        (box((0.075, 0.0, 0.022), (0.024, 0.03, 0.03)), 0.2),
    ]
    for angle in np.radians(arms):
        parts.append((turn(beam((0.02, 0.0, 0.0), (0.185, 0.0, 0.0), 0.026, 0.010), angle), 1.0))
        parts.append((turn(cylinder((0.165, 0.0, -0.024), 0.007, 0.040, sides=6), angle), 0.3))
    return _assembled(parts, motors, 0.076)


def x_frame_racer() -> DroneModel:
    """Small flat racing X frame, longer than wide: 0.25 m from motor to motor, 0.34 m long along x."""
    motors = np.array([(sx * 0.105, sy * 0.068, 0.004) for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
    parts = [
        (box((0.0, 0.0, -0.010), (0.150, 0.040, 0.006)), 1.0),
        (box((-0.005, 0.0, 0.014), (0.120, 0.034, 0.004)), 1.0),
        (box((-0.010, 0.0, 0.002), (0.036, 0.036, 0.014)), 0.2),
        (box((-0.012, 0.0, 0.030), (0.074, 0.036, 0.028)), 0.7),
        (box((0.0, 0.0, 0.030), (0.016, 0.040, 0.032)), 0.0),
        # The camera looks up, because the drone flies nose down.
        (pitch(box((0.072, 0.0, 0.004), (0.022, 0.020, 0.020)), np.radians(35), (0.066, 0.0, 0.0)), 0.3),
        (
            pitch(box((-0.095, 0.0, 0.014), (0.075, 0.006, 0.006)), np.radians(-55), (-0.062, 0.0, 0.014)),
            0.0,
        ),
    ]
    for x in (-0.055, 0.05):
        for y in (-0.013, 0.013):
            parts.append((cylinder((x, y, 0.002), 0.003, 0.022, sides=6), 0.4))
    for x, y, _ in motors:
        end = (x * 1.06, y * 1.06, -0.010)
        parts.append((beam((0.12 * x, 0.12 * y, -0.010), end, 0.016, 0.006), 1.0))
    return _assembled(parts, motors, 0.0635)


def camera_drone() -> DroneModel:
    """Folding camera drone: long rounded body, thin arms at its corners, gimbal below its nose; 0.46 m wide."""
    motors = np.array(
        [(0.14, 0.15, 0.030), (0.14, -0.15, 0.030), (-0.13, 0.14, 0.006), (-0.13, -0.14, 0.006)]
    )
    parts = [
        (box((0.0, 0.0, -0.012), (0.20, 0.085, 0.034), 1.06), 1.0),
        (box((-0.01, 0.0, 0.022), (0.17, 0.075, 0.034), 0.72), 1.0),
        (box((0.105, 0.0, 0.002), (0.03, 0.06, 0.04), 0.8), 0.7),
        (cylinder((0.085, 0.0, -0.045), 0.019, 0.034, sides=8), 0.15),
        (box((0.105, 0.0, -0.045), (0.016, 0.026, 0.026)), 0.05),
    ]
    for x, y, z in motors:
        root = (0.07 if x > 0 else -0.08, 0.035 * np.sign(y), z - 0.022)
        parts.append((beam(root, (x, y, z - 0.014), 0.020, 0.014), 1.0))
    for x, y, _ in motors[:2]:
        parts.append((cylinder((x, y, -0.015), 0.007, 0.06, sides=6), 0.8))
    return _assembled(parts, motors, 0.082)


def hexacopter() -> DroneModel:
    """Hexacopter on landing skids with a payload between them: 0.55 m from motor to motor, 0.80 m overall."""
    arms = (30.0, 90.0, 150.0, 210.0, 270.0, 330.0)
    motors = _ring(0.275, arms, 0.024)
    parts = [
        (cylinder((0.0, 0.0, -0.012), 0.105, 0.006, sides=6), 0.8),
        (cylinder((0.0, 0.0, 0.020), 0.105, 0.006, sides=6), 0.8),
        (cylinder((0.0, 0.0, 0.048), 0.085, 0.05, 0.55, sides=12), 1.0),
        (box((0.0, 0.0, -0.036), (0.15, 0.07, 0.042)), 0.4),
        (cylinder((-0.045, 0.0, 0.100), 0.004, 0.085, sides=6), 0.0),
        (cylinder((-0.045, 0.0, 0.148), 0.028, 0.014, 0.8, sides=10), 0.6),
        # Payload: a stalk, a yoke and a camera.
        (cylinder((0.02, 0.0, -0.078), 0.012, 0.044, sides=8), 0.0),
        (box((0.02, 0.0, -0.104), (0.05, 0.10, 0.010)), 0.2),
        (box((0.03, 0.0, -0.138), (0.095, 0.065, 0.060)), 0.1),
        (pitch(box((0.09, 0.0, -0.138), (0.03, 0.045, 0.045)), np.radians(-20), (0.03, 0.0, -0.138)), 0.0),
    ]
    for angle in np.radians(arms):
        parts.append((turn(beam((0.06, 0.0, 0.004), (0.285, 0.0, 0.004), 0.022, 0.022), angle), 0.9))
    for side in (-1.0, 1.0):
        for x in (-0.07, 0.07):
            parts.append((beam((0.8 * x, 0.06 * side, -0.015), (x, 0.16 * side, -0.205), 0.014, 0.014), 0.5))
        parts.append((beam((-0.17, 0.16 * side, -0.21), (0.17, 0.16 * side, -0.21), 0.018, 0.018), 0.3))
    return _assembled(parts, motors, 0.125)


def tall_cross() -> DroneModel:
    """Cross frame with a tall body and landing legs: 0.40 m from motor to motor, 0.58 m long along x."""
    arms = (0.0, 90.0, 180.0, 270.0)
    motors = _ring(0.20, arms, 0.020)
    parts = [
        (cylinder((0.0, 0.0, 0.0), 0.065, 0.016, sides=12), 0.8),
        (cylinder((0.0, 0.0, 0.045), 0.055, 0.075, 0.75, sides=12), 1.0),
        (cylinder((0.0, 0.0, 0.095), 0.028, 0.03, 0.5, sides=8), 0.4),
        (box((0.0, 0.0, -0.032), (0.11, 0.05, 0.045)), 0.5),
    ]
    for angle in np.radians(arms):
        parts.append((turn(beam((0.03, 0.0, 0.002), (0.21, 0.0, 0.002), 0.020, 0.018), angle), 0.7))
    for angle in np.radians((45.0, 135.0, 225.0, 315.0)):
        parts.append((turn(beam((0.045, 0.0, -0.01), (0.115, 0.0, -0.105), 0.012, 0.012), angle), 0.3))
        parts.append((turn(box((0.118, 0.0, -0.11), (0.03, 0.018, 0.012)), angle), 0.2))
    return _assembled(parts, motors, 0.092)


MODELS: Mapping[str, Callable[[], DroneModel]] = {
    "x_frame": x_frame,
    "x_frame_racer": x_frame_racer,
    "camera_drone": camera_drone,
    "hexacopter": hexacopter,
    "tall_cross": tall_cross,
}

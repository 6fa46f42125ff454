"""Other interpretations of a whole rig: conventions of calibration files that are often confused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from jaxtyping import Float

from psotrack.calibration.doctor.common_points import ExaminedFrames
from psotrack.geometry import Camera, Rig

#: Common factors of the focal lengths: those tried first, and those tried around the best of the first.
_SCALES = np.exp(np.arange(-0.7, 0.7001, 0.1))
_FINER = np.exp(np.arange(-0.1, 0.1001, 0.01))
#: All interpretations are compared in every third frame, and this number of the best in all frames.
_FEW, _KEPT = 3, 8


@dataclass(frozen=True)
class RigInterpretation:
    """A rig that results from another interpretation of the calibration.

    Attributes:
        kind: kind of fault that the calibration has if this interpretation is right.
        words: what was confused.
        remedy: what to do.
        cameras: names of the concerned cameras.
        rig: the rig according to this interpretation.
    """

    kind: str
    words: str
    remedy: str
    cameras: tuple[str, ...]
    rig: Rig


def find_best_interpretation(rig: Rig, seen: ExaminedFrames) -> RigInterpretation:
    """Find the other interpretation of a rig that explains most sightings."""

    def explained(interpretation: RigInterpretation, step: int = 1) -> int:
        return int(replace(seen, frames=seen.frames[::step]).explained(interpretation.rig).sum())

    every = [*_conventions(rig), *_turned_over(rig), *_exchanges(rig), *_lenses(rig, _SCALES)]
    kept = sorted(every, key=lambda each: explained(each, _FEW))[-_KEPT:]
    best = max(kept, key=explained)
    if best.kind == "focal lengths":
        scale = best.rig.cameras.K[0, 0, 0] / rig.cameras.K[0, 0, 0]
        best = max(_lenses(rig, scale * _FINER), key=explained)
    return best


def _conventions(rig: Rig) -> Iterator[RigInterpretation]:
    """Interpretations with translation or centre, world to camera or the reverse, mirrored or normal camera axes."""
    T = rig.cameras.T_cam_world
    for centred, turned, signs in product((False, True), (False, True), product((1.0, -1.0), repeat=3)):
        flip = np.array(signs)
        # Pictures that are upside down are an interpretation of their own.
        if not centred and not turned and signs in ((1.0, 1.0, 1.0), (-1.0, -1.0, 1.0)):
            continue
        R = T[:, :3, :3].swapaxes(-1, -2) if turned else T[:, :3, :3]
        t_m = -np.matvec(R, T[:, :3, 3]) if centred else T[:, :3, 3]
        # With an odd number of mirrored camera axes, an axis of the world is mirrored too, so that R stays a rotation:
        # z if this brings the cameras above the floor, else x.
        world = np.ones(3)
        world[2 if np.matvec(R.swapaxes(-1, -2), t_m)[:, 2].mean() > 0 else 0] = np.prod(flip)
        changed = T.copy()
        changed[:, :3, :3], changed[:, :3, 3] = flip[:, None] * R * world, flip * t_m
        yield _convention(rig, replace(rig.cameras, T_cam_world=changed), centred, turned, flip)


def _convention(
    rig: Rig, cameras: Camera, centred: bool, turned: bool, flip: Float[np.ndarray, "3"]
) -> RigInterpretation:
    axes = ", ".join(axis for axis, sign in zip("xyz", flip, strict=True) if sign < 0)
    hand = " in a left-handed world" if np.prod(flip) < 0 else ""
    opengl = " as in OpenGL" if flip.tolist() == [1.0, -1.0, -1.0] else ""
    also = ", and mirror an axis of the world" if hand else ""
    confused = {
        "its translation is the camera's centre C, which was read as t of x_cam = R X + t": (
            "write t = -R C for each camera" if centred else ""
        ),
        "its rotation is from camera to world, which was read as world to camera": (
            "write the transposed rotation" if turned else ""
        ),
        f"camera axes {axes} are mirrored{opengl}{hand}": (
            f"change the sign of rows {axes} of R and t: cameras have x right, y down, z ahead{also}"
            if axes
            else ""
        ),
    }
    words = [said for said, remedy in confused.items() if remedy]
    remedies = [remedy for remedy in confused.values() if remedy]
    kind = (
        "mirrored axes" if (flip < 0).any() else "translation or centre" if centred else "rotation inverted"
    )
    return RigInterpretation(kind, "; ".join(words), "; ".join(remedies), (), Rig(rig.names, cameras))


def _turned_over(rig: Rig) -> Iterator[RigInterpretation]:
    """Interpretations in which the pictures of all cameras, or of one, are turned by 180 degrees."""
    cameras = rig.cameras
    is_pinhole = np.ones(len(rig), bool) if cameras.fisheye is None else ~np.asarray(cameras.fisheye)
    alone = zip(((name,) for name in rig.names), np.eye(len(rig), dtype=bool), strict=True)
    for names, which in [((), np.ones(len(rig), bool)), *alone]:
        T, K, dist = cameras.T_cam_world.copy(), cameras.K.copy(), np.array(cameras.dist)
        T[which, :2] *= -1
        K[which, :2, 2] = (cameras.image_size_wh - 1)[which] - K[which, :2, 2]
        # Of OpenCV's coefficients, those of tangential distortion, thin prisms and a tilt have a direction.
        dist[which & is_pinhole, 2:4] *= -1
        dist[which & is_pinhole, 8:] *= -1
        yield RigInterpretation(
            "upside down",
            "the pictures are turned by 180 degrees against the rig",
            "turn the pictures back, or calibrate with pictures as they are now",
            names,
            Rig(rig.names, replace(cameras, T_cam_world=T, K=K, dist=dist)),
        )


def _exchanges(rig: Rig) -> Iterator[RigInterpretation]:
    """Interpretations in which the calibrations of two cameras are exchanged."""
    for first, second in combinations(range(len(rig)), 2):
        order = np.arange(len(rig))
        order[[first, second]] = second, first
        names = rig.names[first], rig.names[second]
        yield RigInterpretation(
            "exchanged",
            "what one of them sees fits the calibration of the other",
            "exchange their lines in the calibration, or the names of their videos and detections",
            names,
            Rig(rig.names, rig.cameras[order]),
        )


def _lenses(rig: Rig, scales: Float[np.ndarray, "scales"]) -> Iterator[RigInterpretation]:
    """Interpretations in which all focal lengths are multiplied with a factor."""
    for scale in scales.tolist():
        K = rig.cameras.K.copy()
        K[:, :2, :2] *= scale
        yield RigInterpretation(
            "focal lengths",
            f"all focal lengths are {abs(100 * (1 / scale - 1)):.0f} % too {'short' if scale > 1 else 'long'}",
            f"multiply them by {scale:.3f}, or calibrate each lens anew with `psotrack calibrate rig`",
            (),
            Rig(rig.names, replace(rig.cameras, K=K)),
        )

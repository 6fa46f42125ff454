"""Other ways to read a whole rig: conventions that calibrations are mixed up in, and what follows from each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration import Alike, adjust
from psotrack.correspondence import Sightings
from psotrack.doctor.agreement import UNEXPLAINED, Agreement, agreement
from psotrack.geometry import Camera, CameraRig, reconstruct

#: Common factors of the focal lengths that are tried at first, and then about the best.
_SCALES = np.exp(np.arange(-0.7, 0.7001, 0.1))
_FINER = np.exp(np.arange(-0.1, 0.1001, 0.01))
#: A factor that is nearer to 1 than this is none, because bodies in perspective pass for one; others are off for
#: certain from so many standard deviations on.
_LEAST_OFF, _CERTAIN = 0.02, 3.5
#: Share of a sighting's noise that others of the same camera have in common: for a while, and over the image.
_COMMON = 0.3


@dataclass(frozen=True)
class Reading:
    """A rig read in another way.

    Attributes:
        kind: of the fault that the calibration has if this reading is right.
        words: what was mixed up.
        remedy: what to do.
        cameras: names of those that are concerned.
        rig: as it would be.
    """

    kind: str
    words: str
    remedy: str
    cameras: tuple[str, ...]
    rig: CameraRig


def better_reading(rig: CameraRig, sightings: Sightings, frames: Int[np.ndarray, "chosen"]) -> Reading | None:
    """The reading that explains clearly more sightings (`halfway`), if there is one.

    Args:
        rig: as it was read.
        sightings: of its cameras.
        frames: to look at.
    """
    share = agreement(rig, sightings, frames).share

    def explained(reading: Reading) -> float:
        return agreement(reading.rig, sightings, frames).share

    best = max([*_conventions(rig), *_exchanges(rig), *_lenses(rig, _SCALES)], key=explained)
    if best.kind == "focal lengths":
        scale = best.rig.cameras.K[0, 0, 0] / rig.cameras.K[0, 0, 0]
        best = max(_lenses(rig, scale * _FINER), key=explained)
    return best if explained(best) > halfway(share) else None


def halfway(share: float) -> float:
    """What a reading must explain to be believed: half of what is missing."""
    return (1 + share) / 2


def _conventions(rig: CameraRig) -> Iterator[Reading]:
    """Translation or centre, world to camera or the reverse, camera axes as they are or mirrored."""
    T = rig.cameras.T_cam_world
    for centred, turned, signs in product((False, True), (False, True), product((1.0, -1.0), repeat=3)):
        flip = np.array(signs)
        if not (centred or turned or (flip < 0).any()):
            continue
        R = T[:, :3, :3].swapaxes(-1, -2) if turned else T[:, :3, :3]
        t_m = -np.matvec(R, T[:, :3, 3]) if centred else T[:, :3, 3]
        # A mirrored world keeps an odd number of mirrored camera axes a rotation: z, if cameras are below 0.
        world = np.ones(3)
        world[2 if np.matvec(R.swapaxes(-1, -2), t_m)[:, 2].mean() > 0 else 0] = np.prod(flip)
        cameras = _posed(rig.cameras, flip[:, None] * R * world, flip * t_m)
        yield _convention(rig, cameras, centred, turned, flip)


def _convention(
    rig: CameraRig, cameras: Camera, centred: bool, turned: bool, flip: Float[np.ndarray, "3"]
) -> Reading:
    words, remedies = [], []
    if centred:
        words.append("its translation is the camera's centre C, which was read as t of x_cam = R X + t")
        remedies.append("write t = -R C for each camera")
    if turned:
        words.append("its rotation is from camera to world, which was read as world to camera")
        remedies.append("write the transposed rotation")
    if (flip < 0).any():
        axes = ", ".join(axis for axis, sign in zip("xyz", flip, strict=True) if sign < 0)
        hand = "" if np.prod(flip) > 0 else " in a left-handed world"
        opengl = " as in OpenGL" if flip.tolist() == [1.0, -1.0, -1.0] else ""
        words.append(f"camera axes {axes} are mirrored{opengl}{hand}")
        also = ", and mirror an axis of the world" if hand else ""
        remedies.append(
            f"change the sign of rows {axes} of R and t: cameras have x right, y down, z ahead{also}"
        )
    kind = (
        "mirrored axes" if (flip < 0).any() else "translation or centre" if centred else "rotation inverted"
    )
    return Reading(kind, "; ".join(words), "; ".join(remedies), (), CameraRig(rig.names, cameras))


def _exchanges(rig: CameraRig) -> Iterator[Reading]:
    """The calibrations of two cameras exchanged."""
    for first, second in combinations(range(len(rig)), 2):
        order = np.arange(len(rig))
        order[[first, second]] = second, first
        names = rig.names[first], rig.names[second]
        yield Reading(
            "exchanged",
            "what one of them sees fits the calibration of the other",
            "exchange their lines in the calibration, or the names of their videos and detections",
            names,
            CameraRig(rig.names, rig.cameras[order]),
        )


def better_lenses(rig: CameraRig, found: Agreement, clearly: float) -> Reading | None:
    """All focal lengths times a factor, if points that are matched agree better by `clearly`.

    Points move along with the lenses, so that most are still matched where all are wrong by as much.

    Args:
        rig: as it was read.
        found: its points.
        clearly: share of the views, each by how well it is explained.
    """
    noise_px = np.nan_to_num(found.noise_px, nan=1.0)

    def gain(reading: Reading) -> float:
        lines = reconstruct(
            reading.rig.cameras, found.centre_px, found.used.astype(float), noise_px=noise_px, robust=False
        )
        squared = np.nan_to_num(lines.reprojection_px / noise_px, nan=np.inf) ** 2
        return float(np.where(found.used, np.maximum(0.0, 1 - squared / UNEXPLAINED), 0.0).sum()) / max(
            found.used.sum(), 1
        )

    as_read = gain(next(_lenses(rig, np.ones(1))))
    best = max(_lenses(rig, _SCALES), key=gain)
    scale = best.rig.cameras.K[0, 0, 0] / rig.cameras.K[0, 0, 0]
    best = max(_lenses(rig, scale * _FINER), key=gain)
    return best if gain(best) > as_read + clearly else None


def certain_lenses(rig: CameraRig, found: Agreement) -> Reading | None:
    """All focal lengths times a factor, if a bundle adjustment in which cameras stand still finds it off for certain.

    With other lenses lines of sight pass each other, the farther from the middle of the image the more, because cameras
    stand where they do. A few per cent are less than the noise of one sighting, and more than that of a thousand.

    Args:
        rig: as it was read.
        found: its points.
    """
    seen_px = np.where(found.used[..., None], found.centre_px, np.nan)
    noise_px = np.nan_to_num(found.noise_px, nan=1.0)
    middle_px, size_px = np.asarray(rig.cameras.K)[:, :2, 2], np.asarray(rig.cameras.image_size_wh)
    from_middle = np.nan_to_num((seen_px - middle_px) / (size_px / 2))
    run = np.cumsum(np.diff(found.frame, prepend=found.frame[:1]) > 1)
    common_px, all_of_it = _COMMON * noise_px, np.zeros_like(run)
    alike = [Alike(run, common_px)]
    alike += [Alike(all_of_it, common_px * of) for of in (1.0, *np.moveaxis(from_middle, -1, 0))]
    adjusted = adjust(rig, seen_px, noise_px, fixed=rig.names, rescaled=rig.names, alike=alike)
    scale, std = adjusted.focal_scale, adjusted.focal_scale_std
    if abs(np.log(scale)) < max(_LEAST_OFF, _CERTAIN * std / scale):
        return None
    (reading,) = _lenses(rig, np.array([scale]))
    return replace(reading, words=f"{reading.words}, give or take {100 * std / scale:.1f} %")


def _lenses(rig: CameraRig, scales: Float[np.ndarray, "scales"]) -> Iterator[Reading]:
    """All focal lengths times a factor."""
    for scale in scales.tolist():
        K = rig.cameras.K.copy()
        K[:, :2, :2] *= scale
        yield Reading(
            "focal lengths",
            f"all focal lengths are too {'short' if scale > 1 else 'long'}: {abs(100 * (1 / scale - 1)):.0f} % off",
            f"multiply them by {scale:.3f}, or calibrate the lenses anew",
            (),
            CameraRig(rig.names, replace(rig.cameras, K=K)),
        )


def _posed(cameras: Camera, R: Float[np.ndarray, "n 3 3"], t_m: Float[np.ndarray, "n 3"]) -> Camera:
    T = cameras.T_cam_world.copy()
    T[:, :3, :3], T[:, :3, 3] = R, t_m
    return replace(cameras, T_cam_world=T)

"""Perturbations of a cell's input: compared with frames by hand, SciPy's angles and moments of the binomial."""

import math
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from helpers import cameras_of, ring_rig
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.recordings import Recording, VideoInfo
from psotrack.sweeps import Perturbation, perturb
from psotrack.sweeps.perturbations import choose_cameras

FRAMES, REDUCTION = 70, 4
EVERYTHING = Perturbation(extrinsics_deg=0.3, clock_frames=1.5, flipped=0.05)
ANOTHER_DRAW = Perturbation(extrinsics_deg=0.3, clock_frames=1.5, flipped=0.05, draw=1)


def flown(num_cameras=5, frames=None):
    """A sequence, and silhouettes with the same array (frames, height, width) in every camera."""
    rig = ring_rig(num_cameras, image_size_wh=(28, 20))
    if frames is None:
        frames = np.random.default_rng(3).integers(0, 256, (FRAMES, 5, 7), np.uint8)
    videos = {name: VideoInfo(Path(f"{name}.avi"), len(frames), 25.0, (28, 20)) for name in rig.names}
    silhouettes = Silhouettes(
        cameras=rig.names,
        keys={name: f"key of {name}" for name in rig.names},
        reduction=REDUCTION,
        num_frames=len(frames),
        shape=frames.shape[1:],
        seconds={},
        arrays=tuple(frames + np.uint8(camera) for camera in range(num_cameras)),
    )
    return Recording("S", Path("S"), cameras_of(rig, video=videos)), silhouettes


def frames_of(silhouettes):
    """(frames, cameras, height, width)."""
    return silhouettes.read(0, silhouettes.num_frames)


def test_an_empty_perturbation_changes_nothing():
    sequence, silhouettes = flown()
    assert perturb(sequence, silhouettes, Perturbation(draw=3), None) == (sequence, silhouettes)


def test_equal_draws_give_equal_results_and_other_draws_differ():
    once, again = (perturb(*flown(), EVERYTHING, 3) for _ in range(2))
    assert once[0].rig.names == again[0].rig.names
    np.testing.assert_array_equal(once[0].rig.cameras.T_cam_world, again[0].rig.cameras.T_cam_world)
    np.testing.assert_array_equal(frames_of(once[1]), frames_of(again[1]))
    other = perturb(*flown(), ANOTHER_DRAW, ("c0", "c1"))
    same_cameras = perturb(*flown(), EVERYTHING, ("c0", "c1"))
    assert not np.allclose(other[0].rig.cameras.T_cam_world, same_cameras[0].rig.cameras.T_cam_world)
    assert (frames_of(other[1]) != frames_of(same_cameras[1])).any()


def test_the_input_does_not_change():
    sequence, silhouettes = flown()
    perturb(sequence, silhouettes, EVERYTHING, 2)
    untouched, unflipped = flown()
    np.testing.assert_array_equal(sequence.rig.cameras.T_cam_world, untouched.rig.cameras.T_cam_world)
    np.testing.assert_array_equal(frames_of(silhouettes), frames_of(unflipped))


# --- random streams


def test_random_numbers_of_one_perturbation_do_not_depend_on_the_other_perturbations():
    sequence, silhouettes = flown()
    together, late_and_flipped = perturb(sequence, silhouettes, EVERYTHING, None)
    turned, _ = perturb(sequence, silhouettes, Perturbation(extrinsics_deg=0.3), None)
    np.testing.assert_array_equal(together.rig.cameras.T_cam_world, turned.rig.cameras.T_cam_world)
    # Clocks are perturbed before pixels, so both perturbations at once are the same as one after the other.
    _, late = perturb(sequence, silhouettes, Perturbation(clock_frames=1.5), None)
    _, flipped = perturb(sequence, late, Perturbation(flipped=0.05), None)
    np.testing.assert_array_equal(frames_of(late_and_flipped), frames_of(flipped))


def test_random_numbers_of_a_camera_do_not_depend_on_the_other_cameras():
    every = perturb(*flown(), EVERYTHING, None)
    few = perturb(*flown(), EVERYTHING, ("c3", "c1"))
    np.testing.assert_array_equal(
        few[0].rig.cameras.T_cam_world, every[0].rig.cameras.T_cam_world[np.array([3, 1])]
    )
    np.testing.assert_array_equal(frames_of(few[1]), frames_of(every[1])[:, [3, 1]])


# --- cameras


def test_cameras_are_kept_by_name_or_chosen_at_random():
    chosen, _ = perturb(*flown(), Perturbation(draw=2), 3)
    assert chosen.rig.names == choose_cameras(("c0", "c1", "c2", "c3", "c4"), 3, 2)
    sequence, silhouettes = perturb(*flown(), Perturbation(), ("c4", "c2"))
    assert sequence.rig.names == silhouettes.cameras == tuple(silhouettes.keys) == ("c4", "c2")
    assert tuple(sequence.videos) == ("c4", "c2")
    assert [array[0, 0, 0] for array in silhouettes.arrays] == [
        array[0, 0, 0] for array in (flown()[1].arrays[4], flown()[1].arrays[2])
    ]


def test_cameras_that_do_not_exist():
    with pytest.raises(SettingsError, match=r"cameras: expected some of c0, .*, found c9"):
        perturb(*flown(), Perturbation(), ("c0", "c9"))
    with pytest.raises(SettingsError, match="cameras: expected 1 to 5, the number of cameras, found 6"):
        perturb(*flown(), Perturbation(), 6)


@given(num_cameras=st.integers(1, 7), data=st.data())
def test_draws_use_every_subset_before_a_subset_is_repeated(num_cameras, data):
    names = tuple("abcdefg"[:num_cameras])
    count = data.draw(st.integers(1, num_cameras))
    every = list(combinations(names, count))
    drawn = [choose_cameras(names, count, draw) for draw in range(len(every))]
    # `combinations` keeps the order of the names, as subsets must.
    assert sorted(drawn) == every
    assert choose_cameras(names, count, len(every)) == drawn[0]


def test_every_camera_is_chosen_equally_often():
    names = tuple(map(str, range(20)))
    drawn = [int(name) for draw in range(400) for name in choose_cameras(names, 3, draw)]
    counts = np.bincount(drawn, minlength=20)
    # 400 of 1140 subsets: 60 +- 5.8 of each camera (hypergeometric); 5 standard deviations.
    assert np.abs(counts - 60).max() < 29


# --- extrinsics


def test_cameras_turn_about_their_own_centres_by_the_angle():
    sequence, silhouettes = flown(7)
    turned, same = perturb(sequence, silhouettes, Perturbation(extrinsics_deg=0.2, draw=4), None)
    assert same is silhouettes
    before, after = (each.rig.cameras for each in (sequence, turned))
    # Metres; rounding of float64 at some metres.
    np.testing.assert_allclose(after.centre_world, before.centre_world, rtol=0, atol=1e-12)
    R = after.T_cam_world[:, :3, :3] @ before.T_cam_world[:, :3, :3].swapaxes(-1, -2)
    rotation = Rotation.from_matrix(R)
    np.testing.assert_allclose(np.degrees(rotation.magnitude()), 0.2, rtol=1e-9)
    np.testing.assert_array_equal(after.T_cam_world[:, 3], before.T_cam_world[:, 3])
    axes = rotation.as_rotvec() / rotation.magnitude()[:, None]
    # All cameras turn about different axes.
    assert np.abs(axes @ axes.T - np.eye(7)).max() < 0.999


def test_a_wider_turn_is_about_the_same_axis():
    sequence, silhouettes = flown()
    before = sequence.rig.cameras.T_cam_world[:, :3, :3]
    vectors = []
    for angle in (0.1, 0.4):
        turned, _ = perturb(sequence, silhouettes, Perturbation(extrinsics_deg=angle), None)
        after = turned.rig.cameras.T_cam_world[:, :3, :3]
        vectors.append(Rotation.from_matrix(after @ before.swapaxes(-1, -2)).as_rotvec())
    np.testing.assert_allclose(vectors[1], 4 * vectors[0], rtol=1e-6)


# --- clocks


@pytest.mark.parametrize("clock_frames", [0.5, 1.0, 3.7])
def test_late_cameras_show_earlier_frames(clock_frames):
    """Brightness 3 f at frame f: a camera that is late by s shows 3 (f - s), and 0 before its first frame."""
    ramp = np.tile((3 * np.arange(FRAMES)).astype(np.uint8)[:, None, None], (1, 5, 7))
    sequence, silhouettes = flown(40, ramp)
    silhouettes = replace(silhouettes, arrays=(ramp,) * 40)
    same, late = perturb(sequence, silhouettes, Perturbation(clock_frames=clock_frames), None)
    assert same is sequence
    shown = frames_of(late)[..., 0, 0].astype(float)
    # Only frames without clipped values are used. The mean removes rounding to grey levels, which is at most a half.
    behind = np.arange(FRAMES)[4:, None] - shown[4:] / 3
    lateness = behind.mean(axis=0)
    assert np.abs(behind - lateness).max() < 0.5
    expected = np.maximum(3 * (np.arange(FRAMES)[:, None] - lateness), 0)
    # A half from rounding of the values, and a half from rounding of the delay.
    assert np.abs(shown - expected).max() <= 1.01
    # The smallest of 40 uniform delays is 1/41 of the range on average, and above 0.25 with a probability of 1e-5.
    assert -1 / 6 <= lateness.min() <= 0.25 * clock_frames + 1 / 6
    assert 0.75 * clock_frames - 1 / 6 <= lateness.max() <= clock_frames + 1 / 6


# --- pixels


def test_flipped_pixels_have_the_moments_of_the_binomial():
    share, pixels = 0.03, REDUCTION**2
    frames = np.zeros((600, 20, 20), np.uint8)
    # In each quarter of the image, 0, 4, 12 or 16 of 16 pixels are foreground.
    for part, count in enumerate((0, 4, 12, 16)):
        frames[:, 5 * part : 5 * part + 5] = round(255 * count / pixels)
    sequence, silhouettes = flown(2, frames)
    silhouettes = replace(silhouettes, arrays=(frames, frames))
    same, noisy = perturb(sequence, silhouettes, Perturbation(flipped=share), None)
    assert same is sequence
    values = frames_of(noisy)
    counts = np.round(values / 255 * pixels)
    # Every value is a whole number of pixels.
    np.testing.assert_array_equal(np.round(255 * counts / pixels), values)
    num = values[:, :, :5].size
    variance = pixels * share * (1 - share)
    for part, count in enumerate((0, 4, 12, 16)):
        found = counts[:, :, 5 * part : 5 * part + 5]
        mean = count * (1 - share) + (pixels - count) * share
        assert abs(found.mean() - mean) < 5 * math.sqrt(variance / num)
        # The kurtosis of these counts is below 6, so the variance has a relative error of at most sqrt(5 / num).
        assert abs(found.var() / variance - 1) < 5 * math.sqrt(5 / num)
    assert (values[:, 0] != values[:, 1]).any()


def test_flipping_all_pixels_gives_the_negative():
    frames = np.zeros((60, 5, 7), np.uint8)
    frames[:, 2] = 255
    frames[:, 3] = 64  # 4 of 16 pixels; their negative is 12.
    sequence, silhouettes = flown(1, frames)
    _, negative = perturb(sequence, silhouettes, Perturbation(flipped=1.0), None)
    expected = np.full((60, 5, 7), 255)
    expected[:, 2] = 0
    expected[:, 3] = 191
    np.testing.assert_array_equal(frames_of(negative)[:, 0], expected)

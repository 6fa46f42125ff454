"""What changes around the drones, `scenarios.Surroundings`: places, sizes, times, and what stays as it is."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from placed_drones import (
    PLAIN,
    S02,
    cube,
    hovering,
    laboratory,
    number_image,
    with_drones,
    with_imaging,
)

from psotrack.simulation import (
    RESTLESS,
    CameraRenderer,
    SimulationSettings,
    build,
    change_scenario,
    simulate,
)
from psotrack.simulation.imaging import sensor
from psotrack.simulation.imaging.scenery import Scenery
from psotrack.simulation.scenarios import CameraPlace, Surroundings

SHAPE = (270, 480)
EVERYTHING = Surroundings(lamp_drop=0.2, screen=0.03, foliage=0.03, person=0.5)


def covered(seen_layers, shape=SHAPE):
    """Return the share of each pixel that layers cover, (height, width): white over black is their coverage."""
    rest = np.ones(shape, np.float32)
    for layer in seen_layers:
        rows, columns = layer.seen.shape[:2]
        for row in range(max(layer.y, 0), min(layer.y + rows, shape[0])):
            left, right = max(layer.x, 0), min(layer.x + columns, shape[1])
            if right > left:
                rest[row, left:right] *= layer.seen[row - layer.y, left - layer.x : right - layer.x, 3]
    return 1 - rest


def scenery(stream=0, seed=0, blur_px=0.0, **settings):
    return Scenery(Surroundings(**settings), seed, stream, SHAPE, blur_px)


@pytest.fixture
def still_scene():
    """The laboratory with one black cube in the middle and no other effects."""
    return with_drones(with_imaging(laboratory(), PLAIN), hovering(cube(0.3), (0.3, -0.2, 1.4)))


def with_surroundings(scene, **settings):
    recipe = msgspec.structs.replace(scene.scenario, surroundings=Surroundings(**settings))
    return replace(scene, scenario=recipe)


# --- sizes


@pytest.mark.parametrize("share", [0.02, 0.03, 0.1])
def test_a_screen_covers_the_stated_share(share):
    for stream in range(4):
        one = scenery(stream, screen=share)
        lit = [layer.seen[..., :3].max(axis=-1) > 0.011 for layer in one.layers(1.0)]
        # Sides are rounded to whole pixels: half a pixel of 40 on each.
        assert np.count_nonzero(lit[0]) == pytest.approx(share * SHAPE[0] * SHAPE[1], rel=0.03)


@pytest.mark.parametrize("share", [0.025, 0.4])
def test_leaves_cover_the_stated_share(share):
    for stream in range(2):
        one = scenery(stream, foliage=share)
        found = np.mean([covered(one.layers(time_s)).mean() for time_s in np.arange(0, 5, 0.71)])
        # Leaves sway over the border of the image and over each other; measured within 4 %.
        assert found == pytest.approx(share, rel=0.08)


def test_a_person_is_as_tall_as_stated_and_walks_in_and_out():
    sides = set()
    for stream in range(8):
        one = scenery(stream, person=0.5, person_period_s=6.0)
        assert not one.layers(0.0), "nobody is in the image at the beginning"
        tall, middles = [], []
        for time_s in np.arange(0, 6, 0.1):
            rows, columns = np.nonzero(covered(one.layers(time_s)) > 0.6)
            if len(rows) and 4 < columns.mean() < SHAPE[1] - 5:
                tall.append(np.ptp(rows) + 1)
                middles.append(columns.mean() / SHAPE[1])
        assert max(tall) == pytest.approx(0.5 * SHAPE[0], rel=0.06)
        side = np.round(middles[0])
        sides.add(side)
        inside = np.abs(np.array(middles) - side)
        # In from the side, at most a third of the width, and out on the same side.
        assert inside[0] < 0.1
        assert inside[-1] < 0.1
        assert 0.1 < inside.max() < 0.33
    assert sides == {0.0, 1.0}


def test_all_scales_show_the_same():
    """A twice larger image, reduced, shows what the small image shows."""
    small = Scenery(EVERYTHING, 1, 0, SHAPE, 0.0)
    large = Scenery(EVERYTHING, 1, 0, (2 * SHAPE[0], 2 * SHAPE[1]), 0.0)
    time_s = 6.0
    here, reduced = (
        covered(small.layers(time_s)),
        cv2.resize(covered(large.layers(time_s), (540, 960)), SHAPE[::-1], interpolation=cv2.INTER_AREA),
    )
    # Edges differ by the rounding to pixels; the inside does not.
    assert np.mean(np.abs(here - reduced) > 0.5) < 0.006
    assert here.mean() == pytest.approx(reduced.mean(), rel=0.06)


# --- what changes


def test_a_screen_shows_another_scene_after_a_while():
    one = scenery(screen=0.03)
    shown = np.stack([one.layers(time_s)[0].seen[..., :3] for time_s in np.arange(0, 6, 0.04)])
    change = np.abs(np.diff(shown, axis=0)).mean(axis=(1, 2, 3))
    assert np.all(change > 0), "the content moves in every frame"
    cuts = np.flatnonzero(change > 3 * np.median(change))
    assert len(cuts) in {3, 4}
    np.testing.assert_allclose(np.diff(cuts) * 0.04, 1.7, atol=0.05)


def test_a_lamp_darkens_half_of_the_image_while_it_is_off(still_scene):
    scene = with_surroundings(still_scene, lamp_drop=0.25, lamp_s=(1.0, 2.0))
    calm, restless = CameraRenderer(still_scene, 3), CameraRenderer(scene, 3)
    for time_s, off in ((0.96, False), (1.0, True), (1.96, True), (2.0, False)):
        frame = round(25 * time_s)
        before, after = (one.clean_frame(frame).astype(float) for one in (calm, restless))
        if not off:
            np.testing.assert_array_equal(before, after)
            continue
        bright = before.min(axis=-1) > 60
        light = ((after / np.maximum(before, 1)) ** sensor.GAMMA).mean(axis=-1)
        # Rounding of grey levels of 60 and more, and of the factor, to 8 bits.
        assert light[bright].min() == pytest.approx(0.75, abs=0.03)
        assert light[bright].max() == 1.0
        lost = np.array((restless.scenery._dark[..., 0] / 255.0) ** sensor.GAMMA)
        assert np.mean(lost < 0.875) == pytest.approx(0.5, abs=0.01)
        assert 0.02 < np.mean((lost > 0.76) & (lost < 0.99)) < 0.2, "the edge is soft"


def test_the_lamp_darkens_drones_and_scenery_too(still_scene):
    scene = with_surroundings(still_scene, lamp_drop=1.0, lamp_s=(0.0,), screen=0.1, foliage=0.1)
    shown = CameraRenderer(scene, 0)
    frame = shown.clean_frame(5)
    assert not frame[shown.scenery._dark[..., 0] == 0].any()


def test_the_halves_and_places_differ_between_cameras_and_seeds():
    first, other, seed = (Scenery(EVERYTHING, *which, SHAPE, 0.0) for which in ((0, 0), (0, 1), (1, 0)))
    for one in (other, seed):
        assert (one._dark != first._dark).mean() > 0.1
        places = [[(layer.x, layer.y) for layer in each.layers(0.0)] for each in (first, one)]
        assert places[0] != places[1]


# --- what does not change


def test_drones_are_in_front_and_masks_are_theirs(still_scene):
    scene = with_surroundings(still_scene, foliage=0.9, screen=0.25, person=1.0)
    calm, restless = CameraRenderer(still_scene, 0), CameraRenderer(scene, 0)
    inside = cv2.erode((number_image(calm) > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert inside.sum() > 100
    for frame in (0, 60):
        assert not restless.clean_frame(frame)[inside].any(), "the cube is black"
        np.testing.assert_array_equal(number_image(restless, frame), number_image(calm, frame))


def test_sequences_have_the_same_masks_truth_and_rig(tmp_path):
    # The comment of RESTLESS says what these factors of light are in grey levels: 15 % and 12 %.
    grey = np.array([0.7, 1.36, 1 - RESTLESS["surroundings.lamp_drop"]]) ** (1 / sensor.GAMMA)
    np.testing.assert_allclose(grey, [0.85, 1.15, 0.88], atol=0.001)
    recipe = change_scenario(S02, {"cameras": "laboratory_corners"})
    settings = SimulationSettings(num_frames=2, scale=0.04, onboard=False)
    calm = simulate(recipe, tmp_path / "calm", settings, jobs=1)
    restless = simulate(change_scenario(recipe, RESTLESS), tmp_path / "restless", settings, jobs=1)
    names = {path.relative_to(calm) for path in calm.rglob("*") if path.is_file()}
    assert names == {path.relative_to(restless) for path in restless.rglob("*") if path.is_file()}
    for name in names:
        same = (calm / name).read_bytes() == (restless / name).read_bytes()
        assert same == (name.suffix != ".avi" and name.name != "simulation.json"), name


def test_a_lens_with_distortion_shows_the_scenery_at_the_same_pixels():
    """Scenery has its place in the image, whatever the lens."""
    place = CameraPlace(
        position_m=(-4.7, -3.7, 3.1),
        target_m=(0.1, 0.0, 1.25),
        focal_length_px=700.0,
        distortion=(0.02, 0.01, 0.0, 0.0),
        fisheye=True,
    )
    recipe = change_scenario(
        msgspec.structs.replace(S02, cameras=(place,)), {"imaging": msgspec.to_builtins(PLAIN)}
    )
    leaves = change_scenario(recipe, {"surroundings.foliage": 0.2, "surroundings.screen": 0.05})
    shown, empty = (CameraRenderer(build(each, scale=0.25), 0) for each in (leaves, recipe))
    assert shown.lens is not None
    changed = (shown.clean_frame(7) != empty.clean_frame(7)).any(axis=-1)
    wanted = covered(shown.scenery.layers(shown.scene.time_s(7)), changed.shape)
    # The image is put together with cubic interpolation, whose edges reach two pixels farther.
    near = cv2.dilate((wanted > 0).astype(np.uint8), np.ones((9, 9))) > 0
    inside = cv2.erode((wanted > 0.99).astype(np.uint8), np.ones((5, 5))) > 0
    seen = shown.lens.face >= 0
    assert inside.sum() > 300
    assert changed[inside & seen].mean() > 0.99
    assert changed[seen & ~near].mean() < 0.02

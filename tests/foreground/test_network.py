"""The network that finds drones: loss against loops, training, resuming, its file, and its use."""

import functools
import json
from unittest.mock import Mock

import cv2
import jax.numpy as jnp
import msgspec
import numpy as np
import onnxruntime
import pytest
from helpers import assert_refused
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.foreground.detection import DetectorSettings, find_detector
from psotrack.foreground.learning import Samples, TrainSettings, train
from psotrack.foreground.learning.data_sets import read_data_set
from psotrack.foreground.learning.loss import Targets, losses
from psotrack.foreground.learning.samples import batches, gather
from psotrack.foreground.learning.scores import score
from psotrack.foreground.learning.tracked import TrackedDrones
from psotrack.foreground.learning.variations import Part, varied
from psotrack.foreground.network import Found, findings, model_at, model_path, untrained, write_onnx
from psotrack.foreground.silhouettes import (
    ForegroundSettings,
    SilhouetteSettings,
    find_background,
    scaled_settings,
)
from psotrack.recordings import read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate
from psotrack.trajectories import write_trajectories

#: Side of the pictures, pixels; and settings with which a network learns ten of them by heart.
SIDE = 64
BY_HEART = TrainSettings(epochs=4, steps=60, batch=8, part_px=SIDE, learning_rate=4e-3)


def cross(image, x, y, colour):
    """Draw a drone of 14 x 10 pixels, as a cross."""
    for sign in (-1, 1):
        cv2.line(image, (x - 6, y - 4 * sign), (x + 6, y + 4 * sign), colour, 2)
    return np.array([x - 7, y - 5, x + 8, y + 6], float)


@functools.cache
def pictures(count=10):
    """Pictures with two drones each before a background that is known."""
    generator = np.random.default_rng(0)
    small = generator.integers(60, 200, (8, 8, 3), np.uint8)
    background = cv2.resize(small, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    images, boxes = np.repeat(background[None], count, 0), []
    covered = np.zeros((count, SIDE, SIDE), np.uint8)
    for image, mask in zip(images, covered, strict=True):
        places = [(int(generator.integers(10, 54)), y) for y in (16, 46)]
        boxes.append([cross(mask, *place, 255) for place in places])
        for place in places:
            cross(image, *place, (20, 20, 20))
    return Samples(images, background, covered, np.array(boxes), "pictures")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A network that learned ten pictures by heart."""
    out = tmp_path_factory.mktemp("network") / "drones.model"
    train([pictures()], [pictures()], out, BY_HEART, about={"pictures": 10})
    return out


# --- loss


def entropy(logit, share):
    """Cross entropy of a probability with a share."""
    probability = 1 / (1 + np.exp(-logit))
    return -share * np.log(probability) - (1 - share) * np.log(1 - probability)


def test_the_loss_agrees_with_loops():
    generator = np.random.default_rng(1)
    pixel, middle = generator.normal(0, 2, (2, 8, 12)), generator.normal(-1, 2, (2, 4, 6))
    box = generator.normal(0, 1, (2, 4, 6, 4))
    covered, counts = generator.uniform(0, 1, (2, 8, 12)), generator.random((2, 8, 12)) < 0.8
    # Two drones in the first image: middles at cells (2, 1) and (4, 3); none in the second.
    box_px = np.full((2, 2, 4), np.nan)
    box_px[0] = [[2.0, 1.0, 8.0, 5.0], [7.0, 5.0, 12.0, 8.0]]
    found = Found(*(jnp.asarray(each, jnp.float32) for each in (pixel, middle, box)))
    got = losses(
        found, Targets(*map(jnp.asarray, (covered.astype(np.float32), counts, box_px.astype(np.float32))))
    )

    wanted_px = entropy(pixel, covered)[counts].sum() / (covered[counts].sum() + 2 * 30)
    wanted_middle, wanted_box, learning = 0.0, 0.0, 0
    for image in range(2):
        for row in range(4):
            for column in range(6):
                bells = []
                for x0, y0, x1, y1 in box_px[image][np.isfinite(box_px[image, :, 0])] / 2:
                    middle_x, middle_y = (x0 + x1) / 2, (y0 + y1) / 2
                    dx, dy = middle_x - column - 0.5, middle_y - row - 0.5
                    wide, high = max((x1 - x0) / 6, 0.6), max((y1 - y0) / 6, 0.6)
                    bell = min(np.exp(-0.5 * ((dx / wide) ** 2 + (dy / high) ** 2)), 0.999)
                    if (int(middle_x), int(middle_y)) == (column, row):
                        bell = 1.0
                    bells.append((bell, [dx, dy, np.log((x1 - x0) / 2), np.log((y1 - y0) / 2)]))
                bell, told = max(bells, default=(0.0, None), key=lambda each: each[0])
                logit = middle[image, row, column]
                share = 1 / (1 + np.exp(-logit))
                if bell == 1:
                    wanted_middle += (1 - share) ** 2 * entropy(logit, 1)
                else:
                    wanted_middle += (1 - bell) ** 4 * share**2 * entropy(logit, 0)
                if bell > 0.4:
                    wanted_box += np.abs(box[image, row, column] - told).sum()
                    learning += 1
    # Single precision.
    np.testing.assert_allclose(got.pixel, wanted_px, rtol=1e-5)
    np.testing.assert_allclose(got.middle, wanted_middle / (2 + 2), rtol=1e-5)
    np.testing.assert_allclose(got.box, wanted_box / (learning + 1), rtol=1e-5)


@given(seed=st.integers(0, 2**31), by_boxes=st.booleans())
@settings(max_examples=20, deadline=None)
def test_random_changes_keep_what_is_to_be_learned(seed, by_boxes):
    """Drones stay where they are; further ones have a box of their own; the rest of the picture changes."""
    samples = pictures()
    boxes = np.full((6, 4), np.nan)
    boxes[:2] = samples.box_px[0]
    arrays = (np.asarray(each, np.float32) for each in (samples.image[0], samples.background))
    part = Part(*arrays, samples.covered[0] / np.float32(255), boxes, by_boxes, not by_boxes)
    got = varied(part, lambda: part, np.random.default_rng(seed))
    assert got.image.shape == got.background.shape == part.image.shape
    assert 0 <= got.image.min() <= got.image.max() <= 255
    assert (got.covered >= part.covered).all()
    np.testing.assert_array_equal(got.box_px[:2], boxes[:2])
    x0, y0, x1, y1 = got.box_px[np.isfinite(got.box_px[:, 0])].T
    rows, columns = np.nonzero(got.covered)
    inside = (rows >= y0[:, None]) & (rows < y1[:, None]) & (columns >= x0[:, None]) & (columns < x1[:, None])
    assert inside.any(axis=0).all()
    assert (got.image != part.image).any()
    assert not (by_boxes and got.is_known)


# --- training


@pytest.mark.slow
def test_ten_pictures_are_learned_by_heart(trained):
    found = model_at(trained).card["validation"]
    # The rest are pixels at contours, and drones that hide each other by chance.
    assert found["pixel_f"] > 0.85
    assert found["recall"] > 0.95
    assert found["false_per_frame"] < 0.2
    assert trained.with_suffix(".png").stat().st_size > 10_000
    assert not list(trained.parent.glob("*.unfinished"))


QUICK = TrainSettings(epochs=2, steps=2, batch=2, part_px=32)


def test_an_interrupted_training_goes_on_to_the_same_bytes(tmp_path):
    about = {"pictures": 10}
    train([pictures()], [pictures()], tmp_path / "whole.model", QUICK, about=about)
    # Epoch 2 is cut off, and done again.
    say = Mock(side_effect=[None, KeyboardInterrupt])
    with pytest.raises(KeyboardInterrupt):
        train([pictures()], [pictures()], tmp_path / "part.model", QUICK, about=about, say=say)
    assert (tmp_path / "part.unfinished").exists()
    assert not (tmp_path / "part.model").exists()
    other = TrainSettings(epochs=2, steps=3, batch=2, part_px=32)
    assert_refused(
        lambda: train([pictures()], [pictures()], tmp_path / "part.model", other, about=about),
        "no unfinished training, or one with these samples and settings",
        unchanged=tmp_path,
    )
    train([pictures()], [pictures()], tmp_path / "part.model", QUICK, about=about)
    assert (tmp_path / "part.model").read_bytes() == (tmp_path / "whole.model").read_bytes()
    assert not (tmp_path / "part.unfinished").exists()


def test_a_training_starts_from_a_network(trained, tmp_path):
    out = tmp_path / "drones.model"
    settings = msgspec.structs.replace(QUICK, start=str(trained), learning_rate=1e-4)
    found = train([pictures()], [pictures()], out, settings, about={}).card["validation"]
    assert found["pixel_f"] > 0.85  # four small steps forget nothing; without a start 0.0
    settings = msgspec.structs.replace(QUICK, start="drones.onnx")
    assert_refused(
        lambda: train([pictures()], [pictures()], tmp_path / "b.model", settings, about={}),
        "start: expected network, or a file of `psotrack train` that ends in .model, found drones.onnx",
        unchanged=tmp_path,
    )


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"box_px": np.full((10, 2, 4), np.nan)}, "no drone in any frame"),
        ({"image": np.full((10, SIDE, SIDE, 3), 7, np.uint8)}, "frames of one colour"),
    ],
)
def test_samples_that_teach_nothing_are_refused(change, found, tmp_path):
    samples = Samples(**{**vars(pictures()), **change})
    assert_refused(
        lambda: train([samples], [pictures()], tmp_path / "drones.model", QUICK, about={}),
        found,
        unchanged=tmp_path,
    )


# --- what it learns from


@pytest.fixture
def data_set(tmp_path):
    """A YOLO data set of two images for training and two for validation, 1300 pixels wide, one without drones."""
    folder = tmp_path / "yolo"
    for part in ("train", "val"):
        for kind in ("images", "labels"):
            (folder / kind / part).mkdir(parents=True)
        for number in range(2):
            image = np.full((130, 1300, 3), 90 + 5 * number, np.uint8)
            cross(image, 300, 60, (10, 10, 10))
            cv2.imwrite(str(folder / "images" / part / f"{number}.png"), image)
        (folder / "labels" / part / "0.txt").write_text("0 0.230769 0.461538 0.015385 0.092308\n")
    (folder / "data.yaml").write_text("path: /somewhere/else\ntrain: images/train\nval: images/val\nnc: 1\n")
    return folder


def test_a_yolo_data_set_has_boxes_and_no_masks(data_set, tmp_path):
    train_on, validate_on = read_data_set(data_set, cache=tmp_path / "cache")
    ((samples,), (other,)) = train_on, validate_on
    assert samples.by_boxes
    assert samples.image.shape == (2, 44, 434, 3)  # reduced by 3
    # 20 x 12 pixels about (300, 60).
    np.testing.assert_allclose(samples.box_px[0, 0], [290 / 3, 54 / 3, 310 / 3, 66 / 3], atol=1e-3)
    assert np.isnan(samples.box_px[0, 1:]).all()
    assert np.isnan(samples.box_px[1]).all()
    batch = next(batches([samples, other], 32, 8, np.random.default_rng(0)))
    assert not np.asarray(batch.is_known).any()
    np.testing.assert_array_equal(batch.counts, np.asarray(batch.covered) == 0)
    assert not np.asarray(batch.counts).all()


@pytest.mark.parametrize(
    ("file", "content", "found"),
    [
        ("data.yaml", "train: images/train\n", "expected `val`, a folder of images in"),
        ("data.yaml", "[", "expected the description of a data set in YAML, found none"),
        ("labels/val/0.txt", "0 a b c d\n", "expected lines of a class and four numbers"),
        ("labels/val/0.txt", "0 0.5 7 0.1 0.1\n", "as shares of the image, 0 to 1"),
    ],
)
def test_a_data_set_that_is_none_is_one_line(file, content, found, data_set, tmp_path):
    (data_set / file).write_text(content)
    assert_refused(lambda: read_data_set(data_set, cache=tmp_path / "cache"), found, unchanged=data_set)


@pytest.mark.slow
def test_tracks_teach_what_masks_teach(tmp_path):
    """The foreground near tracks covers the pixels of the masks, but for thin arms and shadows."""
    simulate("S02_D4_A", tmp_path, SimulationSettings(num_frames=50, scale=0.25, onboard=False))
    recording = open_recording(tmp_path / "Simulated_Data" / "S02_D4_A").usable(["cam1", "cam2"])
    tracks = tmp_path / "tracks.csv"
    write_trajectories(tracks, recording.truth)
    assert_refused(lambda: TrackedDrones.read(tracks), unchanged=tmp_path)
    drones = [{"drone": name, "size_m": [0.45, 0.45, 0.25]} for name in recording.truth.drones]
    tracks.with_suffix(".json").write_text(json.dumps({"drones": drones}))
    settings = scaled_settings(SilhouetteSettings(), recording)
    common = {"per_camera": 10, "cache": tmp_path / "cache", "jobs": 1}
    drawn = gather(recording, settings, **common)
    found = gather(recording, settings, tracked=TrackedDrones.read(tracks), **common)
    for by_masks, by_tracks in zip(drawn, found, strict=True):
        # Frames in which a drone has no foreground are left out.
        assert 5 <= len(by_tracks) <= len(by_masks)
        kept = [(each[None] == by_tracks.image).all(axis=(1, 2, 3)).any() for each in by_masks.image]
        first, second = by_masks.covered[kept] >= 128, by_tracks.covered >= 128
        assert 2 * (first & second).sum() / (first.sum() + second.sum()) > 0.7
        assert np.nanmedian(np.abs(by_masks.box_px[kept] - by_tracks.box_px)) <= 2


# --- the file


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (None, "no such file"),
        (b"", "another kind of file"),
        (b"\x00\xff" * 40, "another kind of file"),
        (b'{"kind": "psotrack network", "version": 9}\n', "version 9"),
        (b'{"kind": "psotrack network", "version": 1, "card": {}}\nnothing', "a damaged file"),
    ],
)
def test_a_file_that_is_no_network_is_one_line(content, found, tmp_path):
    path = tmp_path / "drones.model"
    if content is not None:
        path.write_bytes(content)
    for use in (
        lambda: find_detector(str(path), DetectorSettings()),
        lambda: find_background(str(path), ForegroundSettings()),
    ):
        assert_refused(use, found, unchanged=tmp_path)


# --- its use


@pytest.mark.slow
def test_it_serves_as_background_model_and_detector(trained):
    samples = pictures()
    whole = [
        cv2.resize(image, (2 * SIDE, 2 * SIDE), interpolation=cv2.INTER_NEAREST) for image in samples.image
    ]
    model = find_background(
        str(trained), ForegroundSettings(reduction=2, working_reduction=2, min_blob_px=16)
    )
    masks = np.array(list(model.foreground(whole, whole)))
    both = (masks >= 128) & (samples.covered >= 128)
    assert masks.dtype == np.uint8
    assert masks.shape == samples.covered.shape
    assert 2 * both.sum() / ((masks >= 128).sum() + (samples.covered >= 128).sum()) > 0.85
    # Without a background, in pixels of the frame.
    boxes, confidence = find_detector(str(trained), DetectorSettings(size=SIDE)).boxes(whole[0])
    assert boxes.shape == (len(confidence), 4)
    assert (boxes >= 0).all()
    assert (boxes <= 2 * SIDE).all()
    share, own, _ = findings(model_at(trained).network, samples.image[0], None)
    assert share.shape == (SIDE, SIDE)
    assert len(own) <= len(confidence)


def test_a_box_in_which_nothing_moves_has_half_of_the_confidence(trained):
    """An image that differs from its background by 9 grey levels everywhere stands still, and one by 10 does not."""
    network, image = model_at(trained).network, np.clip(pictures().image[0], 0, 200)
    _, still_px, still = findings(network, image, image + np.uint8(9), 0.05)
    _, moving_px, moving = findings(network, image, image + np.uint8(10), 0.05)
    np.testing.assert_allclose(still_px[0], moving_px[0], atol=1)
    # One grey level more changes what the network itself tells by a few per cent.
    assert moving[0] / still[0] == pytest.approx(2, rel=0.15)


def test_as_background_model_it_tells_what_it_or_living_sees_in_boxes(trained):
    """A box of a confidence from 0.2 to 0.3 counts where "living" sees something, as of fainter and fainter drones."""
    shown, network, kinds = pictures(), model_at(trained).network, set()
    settings = ForegroundSettings(reduction=1, working_reduction=1, min_blob_px=1)
    for contrast in (0.2, 0.35, 1.0):
        difference = shown.image - shown.background.astype(float)
        frames = list(np.round(shown.background + contrast * difference).astype(np.uint8))
        told, living = (
            find_background(name, settings).foreground([shown.background] * 4, frames)
            for name in (str(trained), "living")
        )
        for mask, differs, image in zip(told, living, frames, strict=True):
            share, boxes, confidence = findings(network, image, shown.background, 0.2)
            either = np.maximum(differs, np.where(share >= 0.5, np.round(255 * share), 0))
            near = np.zeros(mask.shape, bool)
            for (x0, y0, x1, y1), sure in zip(np.round(boxes).astype(int), confidence >= 0.3, strict=True):
                part = np.s_[max(y0, 0) : y1, max(x0, 0) : x1]
                seen = (differs[part] >= 128).mean() > 0.02
                kinds.add((bool(sure), bool(seen)))
                if sure or seen:
                    np.testing.assert_array_equal(mask[part], either[part])
                    wide, high = x1 - x0, y1 - y0
                    near[max(y0 - high, 0) : y1 + high, max(x0 - wide, 0) : x1 + wide] = True
            assert not mask[~near].any()
    assert kinds >= {(True, True), (False, True), (False, False)}


@pytest.mark.slow
def test_the_network_of_the_package_finds_drones_that_stay(tmp_path):
    """Drones that never move are background to "living"; nothing of these flights is in the network's training."""
    path = model_path("network")
    assert path.stat().st_size < 2_000_000
    changes = {
        f"drones[{number}].flight": {"kind": "orbit", "centre_m": place, "radius_m": [0, 0], "period_s": 9}
        for number, place in enumerate([[1, 1, 1.5], [-1, 1, 1.2], [1, -1, 1.8], [-1, -1, 1.4]])
    }
    recipe = change_scenario(scenario("S02_D4_A"), changes)
    simulate(recipe, tmp_path, SimulationSettings(num_frames=8, scale=0.5, onboard=False))
    recording = open_recording(tmp_path / "Simulated_Data" / recipe.name).usable(["cam1", "cam2"])
    settings = scaled_settings(SilhouetteSettings(), recording)
    samples = gather(recording, settings, per_camera=4, cache=tmp_path / "cache", jobs=1)
    found = score(model_at(path).network, samples)
    # 0.72, with 1.75 false boxes in a frame; of four drones in a frame.
    assert found.recall > 0.5
    assert found.false_per_frame < 4
    covered = {}
    for name in ("living", "network"):
        video = recording.videos["cam1"]
        model = find_background(name, settings)
        masks = list(model.foreground(read_frames(video), read_frames(video)))
        covered[name] = (masks[-1] >= 128) & (samples[0].covered[-1] >= 128)
    assert covered["network"].sum() > 3 * covered["living"].sum()


def test_its_onnx_file_finds_the_same(tmp_path):
    path, network = tmp_path / "drones.onnx", untrained(3)
    assert_refused(lambda: write_onnx(path, network, 60), "a multiple of 8, found 60", unchanged=tmp_path)
    write_onnx(path, network, SIDE)
    image = np.asarray(pictures().image[0])
    blob = cv2.dnn.blobFromImage(image, 1 / 255, swapRB=True)
    (got,) = onnxruntime.InferenceSession(path).run(None, {"images": blob})
    share, boxes, confidence = findings(network, image, None, 0.0)
    assert share.shape == (SIDE, SIDE)
    # Peaks only; the file tells all cells. Both compute in single precision.
    x, y, width, height = got[0, :4].astype(float)
    corners = np.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], axis=-1)
    is_peak = confidence > 0
    assert is_peak.sum() > 10
    for box, told in zip(boxes[is_peak], confidence[is_peak], strict=True):
        nearest = np.abs(corners - box).max(axis=1).argmin()
        np.testing.assert_allclose(corners[nearest], box, atol=1e-3)
        np.testing.assert_allclose(got[0, 4, nearest], told, atol=1e-5)
    # OpenCV takes it as any other network.
    least = float(np.sort(confidence)[-5])
    detector = find_detector(str(path), DetectorSettings(size=SIDE, confidence=least, nms=1.0))
    found, score = detector.boxes(image)
    assert len(found) >= 5
    np.testing.assert_allclose(score.max(), confidence.max(), atol=1e-5)


def test_the_sides_of_a_frame_need_not_be_multiples_of_eight(tmp_path):
    path = tmp_path / "drones.model"
    model = train([pictures()], [pictures()], path, QUICK, about={})
    share, boxes, _ = findings(model.network, np.zeros((37, 53, 3), np.uint8), None, 0.0)
    assert share.shape == (37, 53)
    assert np.isfinite(boxes).all()

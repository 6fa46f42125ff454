"""The ONNX detector with tiny real networks, which find painted white squares exactly."""

import functools
import json

import numpy as np
import pytest
from helpers import assert_refused, make_unnamed_rig, posed, simple_lens
from onnx_models import SIDE, STRIDE, bright_squares

from psotrack.foreground.detection import DetectorSettings, OnnxDetector, detect_drones
from psotrack.geometry import project
from psotrack.geometry.rig_files import write_calibration
from psotrack.recordings import VideoWriter, probe, read_detections
from psotrack.recordings.datasets import CALIBRATION
from psotrack.trajectories import read_trajectories

#: Layout of the output -> side of the network's input, pixels. "v10" needs at least 300 boxes, so 18 x 18 boxes; a
#: network with a suppression of its own mostly has 100.
SIZES = {
    "v5": 128,
    "v8": 128,
    "v10": 168,
    "suppressed": 104,
    "swapped": 104,
    "shares": 128,
    "middles": 104,
    "yolox": 128,
}
#: Pixels of the image per pixel of the network's input.
SCALE = 2
#: (frames, 3), positions of a drone, metres.
PLACES_M = np.linspace([-0.3, -0.2, 1.4], [0.3, 0.2, 1.6], 12)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A folder with the networks, and files that are none."""
    folder = tmp_path_factory.mktemp("models")
    for layout in (*SIZES, "logits", "none", "oriented"):
        content = bright_squares(layout, SIZES.get(layout, 128))
        (folder / f"{layout}.onnx").write_bytes(content)
    (folder / "cut.onnx").write_bytes(bright_squares("v5", 128)[:3000])
    return folder


def square(size, column, row):
    """xyxy of one of the network's squares in the image; the grey border above the image is an eighth of the input."""
    x0 = SCALE * STRIDE * column
    y0 = SCALE * (STRIDE * row - size // 8)
    side = SCALE * SIDE
    return [x0, y0, x0 + side, y0 + side]


def painted(size, *squares, value=255):
    """A black image of twice the width of the network's input and an aspect ratio of 4 to 3, with squares."""
    width = SCALE * size
    bgr = np.zeros((width * 3 // 4, width, 3), np.uint8)
    for x0, y0, x1, y1 in np.maximum(squares, 0):
        bgr[y0:y1, x0:x1] = value
    return bgr


def detector(models, name, **settings):
    said = name if name in ("middles", "yolox") else None
    settings = {"size": SIZES.get(name, 128), "layout": said} | settings
    return OnnxDetector(models / f"{name}.onnx", DetectorSettings(**settings))


@pytest.mark.parametrize("layout", SIZES)
def test_squares_are_found_the_brightest_first(models, layout):
    size = SIZES[layout]
    dim, bright = square(size, 2, 3), square(size, 9, 7)
    xyxy, confidence = detector(models, layout).boxes(painted(size))
    assert (xyxy.shape, confidence.shape) == ((0, 4), (0,))
    bgr = np.maximum(painted(size, dim, value=200), painted(size, bright))
    xyxy, confidence = detector(models, layout).boxes(bgr)
    # The squares' edges are whole pixels of the network's input: exact up to rounding of float32.
    np.testing.assert_allclose(xyxy, [bright, dim], atol=1e-4)
    # OpenCV's convolutions round: measured 2e-4.
    logits = np.array([10, 40 * (200 / 255 - 0.75)])
    np.testing.assert_allclose(confidence, 1 / (1 + np.exp(-logits)), atol=1e-3)
    xyxy, _ = detector(models, layout, confidence=0.9).boxes(bgr)
    np.testing.assert_allclose(xyxy, [bright], atol=1e-4)


def test_overlapping_boxes_are_suppressed(models):
    """A box one stride beside the square has an intersection over union of 3/5 with the square, and half its score."""
    bgr = painted(128, square(128, 5, 6))
    _, alone = detector(models, "v8", nms=0.59).boxes(bgr)
    _, all_five = detector(models, "v8", nms=0.61, confidence=0.4).boxes(bgr)
    assert len(alone) == 1
    np.testing.assert_allclose(all_five, [1, 0.5, 0.5, 0.5, 0.5], atol=1e-3)


def test_boxes_at_the_border_and_in_an_upright_image(models):
    """A quarter of the best square is in the grey border above the image, or, in an upright image, at its side."""
    x0, y0, x1, y1 = square(128, 4, 1)
    assert y0 == -SCALE * STRIDE
    bgr = painted(128, [x0, y0, x1, y1])
    xyxy, _ = detector(models, "v5").boxes(bgr)
    np.testing.assert_allclose(xyxy, [[x0, 0, x1, y1]], atol=1e-4)
    upright = np.ascontiguousarray(bgr.transpose(1, 0, 2))
    xyxy, _ = detector(models, "v5").boxes(upright)
    np.testing.assert_allclose(xyxy, [[0, x0, y1, x1]], atol=1e-4)


def test_the_network_gets_rgb(tmp_path, models):
    """A network that uses only its first channel finds a red square, and no blue one."""
    kernel = np.full((3, SIDE, SIDE), 40 / (3 * SIDE * SIDE), np.float32)
    red_only = np.stack([3 * kernel[0], 0 * kernel[1], 0 * kernel[2]])
    content = bright_squares("v8", 128)
    changed = content.replace(kernel.tobytes(), red_only.tobytes())
    assert changed != content
    path = tmp_path / "red.onnx"
    path.write_bytes(changed)
    blue, red = square(128, 2, 3), square(128, 9, 6)
    bgr = painted(128, blue, value=(255, 0, 0))
    bgr += painted(128, red, value=(0, 0, 255))
    xyxy, _ = OnnxDetector(path, DetectorSettings(size=128)).boxes(bgr)
    np.testing.assert_allclose(xyxy, [red], atol=1e-4)


#: Name of the network -> settings, and words of the line.
BAD = {
    "gone": ({}, "gone.onnx: expected an ONNX model, found no such file"),
    "cut": ({}, "cut.onnx: expected an ONNX model that OpenCV can read"),
    "v8": ({"size": 96}, "expected a network for images of 96 x 96 pixels", "--size"),
    "none": ({}, "none.onnx: expected an output in a layout of YOLO, found (1, 1, 13, 13)"),
    "logits": (
        {},
        "logits.onnx: expected finite boxes with scores from 0 to 1, found scores from -",
        " to 10;",
    ),
    "oriented": (
        {},
        "found scores from -0.5 to 1, as of oriented boxes with their angle; use a network of upright",
    ),
    "middles": (
        {"layout": None},
        "middles.onnx: expected boxes whose layout their numbers show, found ",
        "--layout",
    ),
    "yolox": (
        {"layout": None},
        "yolox.onnx: expected boxes with sizes above 0, found -1, as of YOLOX",
        "--layout",
    ),
    "v5": ({"confidence": 0.0}, "confidence: expected "),
}


@pytest.mark.parametrize("model", BAD)
def test_networks_and_settings_that_cannot_be_used(model, models, capfd):
    settings, *words = BAD[model]
    white = painted(128, [0, 0, 256, 192])
    assert_refused(lambda: detector(models, model, **settings).boxes(white), *words, unchanged=models)
    assert capfd.readouterr() == ("", "")


@pytest.fixture(scope="module")
def flight_folder(tmp_path_factory):
    """Folder with the videos of four cameras, which see a flying drone as a white square, the last not in frame 1."""
    folder = tmp_path_factory.mktemp("tracked") / "Simulated_Data" / "S02_D1"
    folder.mkdir(parents=True)
    lens, places_m = simple_lens(1100.0, (256, 192)), ((0.0, -6.0), (6.0, 0.5), (-0.5, 6.0), (-6.0, -0.5))
    rig = make_unnamed_rig(*(posed(lens, (*place_m, 2.0), (0.0, 0.0, 1.5)) for place_m in places_m))
    write_calibration(folder / CALIBRATION, rig)
    for index, name in enumerate(rig.names):
        with VideoWriter(folder / f"{name}.avi", 25.0, (256, 192)) as writer:
            for frame, there in enumerate(squares_of(rig, index)):
                bgr = painted(128, there)
                if name == "3" and frame == 1:
                    bgr[:] = 0
                writer.write(bgr)
    return folder, rig


def squares_of(rig, index):
    """The square of the network that is nearest to the drone, in each frame of a camera."""
    middles, _ = project(rig.cameras[index], PLACES_M)
    corners = middles - SIDE + [0, SCALE * 16]
    places = np.rint(corners / (SCALE * STRIDE)).astype(int)
    return [square(128, column, row) for column, row in places.tolist()]


def test_detect_writes_a_file_per_camera(models, flight_folder, run_psotrack, tmp_path, caplog):
    folder, rig = flight_folder
    found = detect_drones(detector(models, "v5"), "3", probe(folder / "3.avi"))
    frames = [0, *range(2, 12)]
    assert found.frame.tolist() == frames
    # Compression changes the colours, but not which square has the highest score.
    squares = squares_of(rig, 3)
    np.testing.assert_allclose(found.xyxy, [squares[frame] for frame in frames], atol=1e-4)
    detect = functools.partial(
        run_psotrack, "detect", folder, "--detector", models / "v8.onnx", "--size", 128
    )
    assert "4 cameras, 12 frames, 0.98 boxes per frame and camera" in detect("--out", tmp_path / "a").out
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == ["0.csv", "1.csv", "2.csv", "3.csv"]
    written = read_detections(tmp_path / "a" / "3.csv")
    assert written.frame.tolist() == frames
    np.testing.assert_allclose(written.xyxy, found.xyxy, atol=1e-4)
    some = detect("--out", tmp_path / "b", "--cameras", "3", "--frames", 3, "--json", "-")
    assert json.loads(some.out) == {"out": str(tmp_path / "b"), "frames": 3, "detections": {"3": 2}}
    caplog.clear()
    detect("--out", tmp_path / "c", "--confidence", 1.0, "--frames", 3)
    assert "not a box in the whole recording" in caplog.text
    run_psotrack("track", folder, "--method", "projection-lines", "--detections", tmp_path / "c")
    assert "no camera has a detection in the whole recording" in caplog.text


def test_track_makes_detections_and_keeps_them(models, flight_folder, run_psotrack, tmp_path, monkeypatch):
    folder, _ = flight_folder
    of_detector = ("--detector", models / "v8.onnx", "--detector-size", 128, "--cache", tmp_path / "cache")
    track = functools.partial(run_psotrack, "track", folder, *of_detector, "--json", "-", "--out")
    first, second = tmp_path / "a.csv", tmp_path / "b.csv"
    lines = ("--method", "projection-lines")
    found = track(first, *lines)
    tracks = read_trajectories(first)
    assert tracks.num_drones == 1
    # The network's squares are 16 pixels apart: errors up to 8 pixels are 4.4 cm at 6 m.
    off_m = np.linalg.norm(tracks.position_m[:, 0] - PLACES_M, axis=-1)
    assert tracks.seen.all()
    assert off_m.max() < 0.08
    # The second run uses the stored detections.
    monkeypatch.setattr(OnnxDetector, "boxes", lambda *_: pytest.fail("looked again"))
    again = track(second, *lines)
    assert first.read_bytes() == second.read_bytes()
    assert json.loads(found.out)["input_keys"] == json.loads(again.out)["input_keys"]
    # A detector that would not be used is refused.
    words = "expected ", " such as projection-lines or fused, found method swarm"
    assert_refused(functools.partial(track, tmp_path / "c.csv"), *words, unchanged=tmp_path)

"""The ONNX detector with tiny real networks, which find painted white squares exactly."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from helpers import make_unnamed_rig
from onnx_models import SIDE, STRIDE, bright_squares

from psotrack.cli.detect import detect as command
from psotrack.cli.track import track
from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.foreground.detection import DetectorSettings, OnnxDetector, detect_drones
from psotrack.geometry import look_at, make_camera, project
from psotrack.geometry.rig_files import write_calibration
from psotrack.recordings import VideoWriter, probe, read_detections
from psotrack.recordings.datasets import CALIBRATION
from psotrack.trajectories import read_trajectories

#: Layout of the output -> side of the network's input, pixels. "v10" needs at least 300 boxes, so 18 x 18 boxes.
SIZES = {"v5": 128, "v8": 128, "v10": 168}
#: Pixels of the image per pixel of the network's input.
SCALE = 2
#: (frames, 3), positions of a drone, metres.
PLACES_M = np.linspace([-0.3, -0.2, 1.4], [0.3, 0.2, 1.6], 12)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for layout in (*SIZES, "logits", "none"):
        (folder / f"{layout}.onnx").write_bytes(bright_squares(layout, SIZES.get(layout, 128)))
    return folder


def black(size: int):
    """Black image with twice the width of the network's input and an aspect ratio of 4 to 3."""
    return np.zeros((SCALE * size * 3 // 4, SCALE * size, 3), np.uint8)


def square(size: int, column: int, row: int):
    """xyxy of one of the network's squares in the image; the grey border above the image is an eighth of the input."""
    x0, y0 = SCALE * STRIDE * column, SCALE * (STRIDE * row - size // 8)
    return [x0, y0, x0 + SCALE * SIDE, y0 + SCALE * SIDE]


def paint(bgr, xyxy, value=255):
    x0, y0, x1, y1 = (max(0, edge) for edge in xyxy)
    bgr[y0:y1, x0:x1] = value


def detector(models, layout, **settings):
    settings = {"size": SIZES.get(layout, 128)} | settings
    return OnnxDetector(models / f"{layout}.onnx", DetectorSettings(**settings))


@pytest.mark.parametrize("layout", SIZES)
def test_squares_are_found_the_brightest_first(models, layout):
    size = SIZES[layout]
    bgr, dim, bright = black(size), square(size, 2, 3), square(size, 9, 7)
    xyxy, confidence = detector(models, layout).boxes(bgr)
    assert (xyxy.shape, confidence.shape) == ((0, 4), (0,))
    paint(bgr, dim, 200)
    paint(bgr, bright)
    xyxy, confidence = detector(models, layout).boxes(bgr)
    # The squares' edges are whole pixels of the network's input: exact up to rounding of float32.
    np.testing.assert_allclose(xyxy, [bright, dim], atol=1e-4)
    # OpenCV's convolutions round: measured 2e-4.
    np.testing.assert_allclose(confidence, 1 / (1 + np.exp([-10, -40 * (200 / 255 - 0.75)])), atol=1e-3)
    xyxy, _ = detector(models, layout, confidence=0.9).boxes(bgr)
    np.testing.assert_allclose(xyxy, [bright], atol=1e-4)


def test_overlapping_boxes_are_suppressed(models):
    """A box one stride beside the square has an intersection over union of 3/5 with the square, and half its score."""
    bgr = black(128)
    paint(bgr, square(128, 5, 6))
    _, alone = detector(models, "v8", nms=0.59).boxes(bgr)
    _, all_five = detector(models, "v8", nms=0.61, confidence=0.4).boxes(bgr)
    assert len(alone) == 1
    np.testing.assert_allclose(all_five, [1, 0.5, 0.5, 0.5, 0.5], atol=1e-3)


def test_boxes_are_clipped_to_the_image(models):
    """A quarter of the best square is in the grey border above the image."""
    bgr, there = black(128), square(128, 4, 1)
    assert there[1] == -SCALE * STRIDE
    paint(bgr, there)
    xyxy, _ = detector(models, "v5").boxes(bgr)
    np.testing.assert_allclose(xyxy, [[there[0], 0, *there[2:]]], atol=1e-4)


def test_an_upright_image_gets_grey_borders_at_its_sides(models):
    bgr, there = black(128), square(128, 5, 6)
    paint(bgr, there)
    upright = np.ascontiguousarray(bgr.transpose(1, 0, 2))
    xyxy, _ = detector(models, "v8").boxes(upright)
    np.testing.assert_allclose(xyxy, [[there[1], there[0], there[3], there[2]]], atol=1e-4)


def test_the_network_gets_rgb(tmp_path, models):
    """A network that uses only its first channel finds a red square, and no blue one."""
    kernel = np.full((3, SIDE, SIDE), 40 / (3 * SIDE * SIDE), np.float32)
    red_only = np.stack([3 * kernel[0], 0 * kernel[1], 0 * kernel[2]])
    content = bright_squares("v8", 128)
    assert content.count(kernel.tobytes()) == 1
    path = tmp_path / "red.onnx"
    path.write_bytes(content.replace(kernel.tobytes(), red_only.tobytes()))
    bgr = black(128)
    paint(bgr, square(128, 2, 3), (255, 0, 0))
    paint(bgr, square(128, 9, 6), (0, 0, 255))
    xyxy, _ = OnnxDetector(path, DetectorSettings(size=128)).boxes(bgr)
    np.testing.assert_allclose(xyxy, [square(128, 9, 6)], atol=1e-4)


class TestInvalidModels:
    def test_a_missing_file(self, tmp_path):
        with pytest.raises(InputError, match=r"gone.onnx: expected an ONNX model, found no such file"):
            OnnxDetector(tmp_path / "gone.onnx", DetectorSettings())

    @pytest.mark.parametrize("content", [b"", b"hello " * 100, "cut"])
    def test_a_broken_model(self, tmp_path, capfd, content):
        path = tmp_path / "broken.onnx"
        path.write_bytes(bright_squares("v5", 128)[:3000] if content == "cut" else content)
        with pytest.raises(
            InputError, match=r"broken.onnx: expected an ONNX model that OpenCV can read"
        ) as error:
            OnnxDetector(path, DetectorSettings())
        assert "\n" not in str(error.value)
        assert capfd.readouterr() == ("", "")

    @pytest.mark.parametrize(
        ("layout", "size", "words"),
        [
            ("v8", 96, "a network for images of 96 x 96 pixels.*--size"),
            ("v8", 640, "a network for images of 640 x 640 pixels.*--size"),
            ("none", 128, r"none.onnx: .* layout of YOLO, found \(1, 1, 13, 13\)"),
            ("logits", 128, "logits.onnx: expected .* from 0 to 1, found scores from 0 to 10;"),
        ],
    )
    def test_models_for_other_images_or_with_other_outputs(self, models, capfd, layout, size, words):
        with pytest.raises(InputError, match=words) as error:
            detector(models, layout, size=size).boxes(np.full_like(black(128), 255))
        assert "\n" not in str(error.value)
        assert capfd.readouterr() == ("", "")

    @pytest.mark.parametrize("settings", [{"confidence": 0.0}, {"nms": 1.5}, {"size": 0}])
    def test_invalid_settings(self, settings):
        with pytest.raises(SettingsError, match=next(iter(settings))):
            DetectorSettings(**settings)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Folder with two videos of four frames: a moving square in the first video, an empty second video."""
    folder = tmp_path_factory.mktemp("data") / "Simulated_Data" / "S02_D1"
    folder.mkdir(parents=True)
    R, t_m = look_at((0.0, -6.0, 2.0), (0.0, 0.0, 1.5))
    one = make_camera(R=R, t_m=t_m, K=np.diag([1100.0, 1100.0, 1.0]), image_size_wh=(256, 192))
    write_calibration(folder / CALIBRATION, make_unnamed_rig(one, one))
    for name in "01":
        with VideoWriter(folder / f"{name}.avi", 25.0, (256, 192)) as writer:
            for frame in range(4):
                bgr = black(128)
                if name == "0" and frame != 1:
                    paint(bgr, square(128, 3 + frame, 6))
                writer.write(bgr)
    return folder


class TestVideos:
    def test_boxes_of_all_frames(self, models, sequence):
        found = detect_drones(detector(models, "v5"), "0", probe(sequence / "0.avi"))
        assert found.frame.tolist() == [0, 2, 3]
        # Compression changes the colours, but not which square has the highest score.
        np.testing.assert_allclose(found.xyxy, [square(128, 3 + frame, 6) for frame in (0, 2, 3)], atol=1e-4)

    def run(self, models, sequence, out, *arguments):
        options = ["--detector", models / "v8.onnx", "--out", out, "--size", "128", *arguments]
        return CliRunner().invoke(command, [str(sequence), *map(str, options)], catch_exceptions=False)

    def test_the_command_writes_a_file_per_camera(self, models, sequence, tmp_path):
        (tmp_path / "1.csv").write_text("mine")
        with pytest.raises(OutputError, match=r"1.csv: .*--force"):
            self.run(models, sequence, tmp_path)
        assert not (tmp_path / "0.csv").exists()
        result = self.run(models, sequence, tmp_path, "--force")
        assert result.exit_code == 0
        assert "2 cameras, 4 frames, 0.38 boxes per frame and camera" in result.stdout
        assert sorted(path.name for path in tmp_path.iterdir()) == ["0.csv", "1.csv"]
        found = read_detections(tmp_path / "0.csv")
        assert found.frame.tolist() == [0, 2, 3]
        np.testing.assert_allclose(found.in_frame(3).xyxy, [square(128, 6, 6)], atol=1e-4)
        assert len(read_detections(tmp_path / "1.csv")) == 0

    def test_json_of_selected_cameras_and_frames(self, models, sequence, tmp_path):
        result = self.run(models, sequence, tmp_path / "b", "--cameras", "0", "--frames", "3", "--json", "-")
        expected = {"out": str(tmp_path / "b"), "frames": 3, "detections": {"0": 2}}
        assert json.loads(result.stdout) == expected


@pytest.fixture(scope="module")
def flight_folder(tmp_path_factory):
    """Folder with the videos of four cameras, which see a flying drone as a white square."""
    folder = tmp_path_factory.mktemp("tracked") / "Simulated_Data" / "S02_D1"
    folder.mkdir(parents=True)
    cameras = []
    for x_m, y_m in ((0.0, -6.0), (6.0, 0.5), (-0.5, 6.0), (-6.0, -0.5)):
        R, t_m = look_at((x_m, y_m, 2.0), (0.0, 0.0, 1.5))
        K = np.array([[1100.0, 0.0, 127.5], [0.0, 1100.0, 95.5], [0.0, 0.0, 1.0]])
        cameras.append(make_camera(R=R, t_m=t_m, K=K, image_size_wh=(256, 192)))
    rig = make_unnamed_rig(*cameras)
    write_calibration(folder / CALIBRATION, rig)
    middles, _ = project(rig.cameras, PLACES_M[:, None])
    for index, name in enumerate(rig.names):
        with VideoWriter(folder / f"{name}.avi", 25.0, (256, 192)) as writer:
            for x, y in middles[:, index]:
                bgr = black(128)
                column, row = (round((at - SIDE) / (SCALE * STRIDE)) for at in (x, y + SCALE * 16))
                paint(bgr, square(128, column, row))
                writer.write(bgr)
    return folder


class TestTracking:
    """`psotrack track` with a detector, on the videos of four cameras."""

    def run(self, models, flight_folder, out, *arguments):
        words = [
            flight_folder,
            "--out",
            out,
            "--cache",
            out.parent / "cache",
            "--detector",
            models / "v8.onnx",
        ]
        words += ["--detector-size", "128", *arguments]
        return CliRunner().invoke(track, [*map(str, words)], catch_exceptions=False)

    def test_detections_are_made_by_the_command_and_kept(self, models, flight_folder, tmp_path, monkeypatch):
        arguments = ("--method", "projection-lines", "--json", "-")
        found = self.run(models, flight_folder, tmp_path / "a.csv", *arguments)
        assert found.exit_code == 0
        tracks = read_trajectories(tmp_path / "a.csv")
        assert tracks.num_drones == 1
        # The network's squares are 16 pixels apart: errors up to 8 pixels are 4.4 cm at 6 m.
        off_m = np.linalg.norm(tracks.position_m[:, 0] - PLACES_M, axis=-1)
        assert tracks.seen.all()
        assert off_m.max() < 0.08
        # The second run uses the stored detections.
        monkeypatch.setattr(OnnxDetector, "boxes", lambda *_: pytest.fail("looked again"))
        again = self.run(models, flight_folder, tmp_path / "b.csv", *arguments)
        assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
        keys = [json.loads(result.stdout)["input_keys"] for result in (found, again)]
        assert keys[0] == keys[1]

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ((), r"detector: expected .* such as projection-lines or fused, found method swarm"),
            (("--method", "fused", "--detections", "blobs"), r"detector: .* found detections blobs"),
        ],
    )
    def test_detector_options_that_are_not_used(self, models, flight_folder, tmp_path, arguments, message):
        with pytest.raises(SettingsError, match=message):
            self.run(models, flight_folder, tmp_path / "a.csv", *arguments)

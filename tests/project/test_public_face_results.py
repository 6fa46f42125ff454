"""Functions of the public face give what the commands print, and `help` of the package is short."""

import json
import subprocess
import sys

import numpy as np
import pytest
from board_rigs import row_of_cameras

import psotrack as pt
from psotrack.calibration.clocks import ReferenceOffset
from psotrack.errors import InputError, PsotrackError
from psotrack.evaluation import Offset
from psotrack.geometry import project
from psotrack.recordings import VideoWriter

#: Ten screens of 50 lines.
MOST_LINES = 500
RIG = row_of_cameras(3)


def python(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_help_of_the_package_fits_ten_screens():
    """Found: 2,453 lines, the help of every name."""
    lines = python("import psotrack as pt; help(pt)").splitlines()
    assert 50 < len(lines) < MOST_LINES
    assert max(map(len, lines)) <= 124  # prose of 120 characters, indented by pydoc


def test_a_sweep_may_be_called_before_and_after_its_room_is_loaded():
    """The room stands at `psotrack.sweeps` once it is loaded, and must not hide the function."""
    for before in ("", "import psotrack.sweeps.store; "):
        said = python(
            f"import psotrack as pt; {before}\ntry: pt.sweep(3, 'out')\nexcept Exception as error: print(error)"
        )
        assert said.startswith("sweep(), grid: expected a Grid")


def write_pairs(path):
    points_m = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 2), (14, 3))
    pixels = project(RIG.cameras, points_m[:, None])[0]
    rows = ["camera,point,x_px,y_px,x_m,y_m,z_m"]
    for index, name in enumerate(RIG.names):
        rows += [
            f"{name},p{k},{pixels[k, index, 0]},{pixels[k, index, 1]},{x},{y},{z}"
            for k, (x, y, z) in enumerate(points_m)
        ]
    path.write_text("\n".join(rows))
    return path


def test_a_rig_in_python_is_that_of_the_command(tmp_path, run_psotrack):
    pairs, lenses, out = write_pairs(tmp_path / "pairs.csv"), tmp_path / "lenses.toml", tmp_path / "rig.toml"
    pt.write_rig(lenses, RIG)
    words = ("calibrate", "rig", "--pairs", pairs, "--lenses", lenses, "--out", out)
    printed = run_psotrack(*words)
    shown = json.loads(run_psotrack(*words, "--force", "--json", "-").out)
    found = pt.calibrate_rig(pairs=f"{pairs}", lenses=lenses, out=out, force=True)
    assert json.loads(json.dumps(found.to_dict())) == shown
    assert f"{found}\n" == printed.out
    np.testing.assert_allclose(found.rig.cameras.centre_world, RIG.cameras.centre_world, atol=1e-4)
    assert "<table" in found._repr_html_()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: pt.calibrate_rig(), "expected one of --square, --squares, --points"),
        (lambda: pt.calibrate_rig(square_m=0.04), "expected a video, a folder or a pattern"),
        (lambda: pt.calibrate_rig("board", square=0.04), r"calibrate_rig\(\): .*did you mean squares\?"),
        (lambda: pt.calibrate_rig("board", square_m="4 cm"), r"square_m: expected a number or None"),
        (lambda: pt.calibrate_rig("board", squares="7x5"), r"squares: expected a tuple or None"),
        (lambda: pt.run("my_lab", squares=3), r"run\(\): expected .*, found squares"),
        (lambda: pt.run("nothing"), "nothing: expected a video of each camera"),
        (lambda: pt.doctor("nothing"), "nothing: expected a recording.toml"),
        (lambda: pt.doctor("nothing", bounds_m=3), r"doctor\(\), bounds_m: expected"),
        (lambda: pt.report("nothing.csv"), "nothing.csv: expected"),
        (lambda: pt.report(()), "files: expected one or more paths"),
        (lambda: pt.overlay("nothing.csv", mosaik=True), r"overlay\(\): .*did you mean mosaic\?"),
        (lambda: pt.overlay("nothing.csv", cameras="left"), r"cameras: expected a sequence or None"),
        (lambda: pt.sweep("nothing.toml", "out"), "nothing.toml: expected"),
    ],
)
def test_wrong_calls_are_one_line(call, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PsotrackError, match=words) as error:
        call()
    assert "\n" not in str(error.value)


def write_video(path, fps=25.0, frames=3):
    with VideoWriter(path, fps, (64, 48)) as video:
        for _ in range(frames):
            video.write(np.zeros((48, 64, 3), np.uint8))


def test_a_board_video_without_frames_is_named(tmp_path):
    """Found: a line about a folder of images."""
    (tmp_path / "board").mkdir()
    with pytest.raises(InputError, match=r"expected a folder with videos or images, found nei"):
        pt.calibrate_rig(tmp_path / "board", square_m=0.04)
    write_video(tmp_path / "board" / "left.avi")
    (tmp_path / "board" / "right.mp4").touch()
    with pytest.raises(InputError, match=r"right\.mp4: expected a video, found an empty file"):
        pt.calibrate_rig(tmp_path / "board", square_m=0.04)


def test_a_folder_with_a_recording_has_the_times_of_the_recording(tmp_path):
    """Videos of different rates cannot be paired by the numbers of their frames, but by a recording's times."""
    for name, fps in (("left", 25.0), ("right", 50.0)):
        write_video(tmp_path / f"{name}.avi", fps)
    with pytest.raises(InputError, match="expected 25 frames per second"):
        pt.calibrate_rig(tmp_path, square_m=0.04)
    cameras = "".join(f'[cameras.{name}]\nvideo = "{name}.avi"\n' for name in ("left", "right"))
    (tmp_path / "recording.toml").write_text(f"version = 1\n{cameras}")
    with pytest.raises(InputError, match="expected a ChArUco board or a chessboard"):
        pt.calibrate_rig(tmp_path, square_m=0.04)


def test_an_offset_says_what_the_command_prints():
    none = np.zeros(0)
    offset = Offset(0.4, 0.01, 0.02, None, np.zeros((1, 3)), np.zeros(1, int), 1.0, none, none)
    found = ReferenceOffset("R12", offset, {"dron1": "0"}, 25.0, "world")
    assert str(found).startswith("R12: the reference's clock is 0.4000 s (± 0.0100 s) ahead of the videos'")
    assert found.to_dict()["drones"] == [{"drone": "dron1", "estimate": "0", "lever_arm_m": [0, 0, 0]}]

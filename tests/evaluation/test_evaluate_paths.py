"""`psotrack evaluate` of paths with orientations: evo as oracle, planted clocks, and axes."""

import json

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from evo.core import metrics, sync
from evo.tools import file_interface
from real_data import published
from scipy.spatial.transform import Rotation
from test_path_comparison import ARM_M, FPS, TURN, body, compare, filmed_path, recording

from psotrack.cli.evaluate import evaluate
from psotrack.errors import InputError
from psotrack.inside_out import CameraPath, write_camera_path
from psotrack.recordings.exchange import read_tracks
from psotrack.trajectories import write_trajectories
from psotrack.trajectories.tum import write_tum

CLOCK_S, TURN_CLOCK_S = 0.3137, -2.173


def run(*words):
    result = CliRunner().invoke(evaluate, [*map(str, words), "--json", "-"], catch_exceptions=False)
    assert result.exit_code == 0
    return json.loads(result.stdout)


def tum_file(folder, name, time_s, position_m, wxyz):
    (folder / name).mkdir()
    (path,) = write_tum(folder / name, body(time_s, position_m, wxyz))
    return path.rename(folder / f"{name}.tum")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The table of `localise` of a flight, the reference at 100 Hz and an IMU at 25 Hz by clocks of their own."""
    folder = tmp_path_factory.mktemp("paths")
    path = filmed_path(ARM_M, TURN, noise_m=0.005, noise_deg=0.2)
    table, count = folder / "dron1.csv", path.num_frames
    write_camera_path(
        table,
        CameraPath(
            frame=path.frame,
            time_s=path.time_s,
            position_m=path.position_m[:, 0],
            orientation_wxyz=path.orientation_wxyz[:, 0],
            covariance=np.tile(1e-5 * np.eye(6), (count, 1, 1)),
            num_markers=np.full(count, 6),
            reprojection_px=np.full(count, 0.3),
            ambiguity=np.zeros(count),
            status=path.status[:, 0],
            flags=np.zeros(count, int),
        ),
        "dron1",
    )
    vicon = tum_file(folder, "vicon", *recording(clock_s=CLOCK_S))
    time_s, _, wxyz = recording(rate_hz=25, clock_s=TURN_CLOCK_S)
    imu = tum_file(folder, "imu", time_s, np.zeros((len(time_s), 3)), wxyz)
    return table, vicon, imu


def test_tables_7_and_8_of_a_localised_video(files):
    """The command gives the numbers of the function that the experiment of Tables 7 and 8 calls."""
    table, vicon, imu = files
    found = run(table, vicon, "--orientations", imu)
    assert found["offset_s"] == pytest.approx(CLOCK_S, abs=0.05 / FPS)
    assert found["orientation_offset_s"] == pytest.approx(TURN_CLOCK_S, abs=0.05 / FPS)
    np.testing.assert_allclose(found["lever_arm_m"], ARM_M, atol=0.0024)
    assert (TURN.inv() * Rotation.from_quat(found["turn_wxyz"], scalar_first=True)).magnitude() < np.radians(
        0.1
    )
    time_s, position_m, _ = recording(clock_s=CLOCK_S)
    turns_s, _, wxyz = recording(rate_hz=25, clock_s=TURN_CLOCK_S)
    path = filmed_path(ARM_M, TURN, noise_m=0.005, noise_deg=0.2)
    expected = compare(path, time_s, position_m, wxyz, orientation_time_s=turns_s).to_dict()
    # The text of the files holds 64 bits, but unit quaternions are normalised anew.
    for name in (
        "distance_m",
        "distance_to_point_m",
        "roll_deg",
        "pitch_deg",
        "yaw_deg",
        "abs_yaw_deg",
        "angle_deg",
    ):
        assert found[name] == pytest.approx(expected[name], abs=1e-5), name


def test_the_table_that_people_read(files, tmp_path):
    table, vicon, _ = files
    picture = tmp_path / "path.png"
    result = CliRunner().invoke(
        evaluate, [str(table), str(vicon), "--plot", str(picture)], catch_exceptions=False
    )
    assert "the reference's clock is +0.31" in result.stdout
    for words in ("distance (mm)", "roll (deg)", "abs yaw (deg)", "lever arm +1"):
        assert words in result.stdout
    assert cv2.imread(str(picture)).shape[0] > 600


def evo_ape(estimate, reference, offset_s=0.0):
    """Statistics of evo's absolute pose errors, metres and degrees, of poses at equal times."""
    ref, est = map(file_interface.read_tum_trajectory_file, (str(reference), str(estimate)))
    est.timestamps = est.timestamps + offset_s
    ref, est = sync.associate_trajectories(ref, est, max_diff=0.02)
    found = []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
        ape = metrics.APE(relation)
        ape.process_data((ref, est))
        found.append(ape.get_all_statistics())
    return found


def same(ours, theirs, **tolerance):
    for key, name in {"minimum": "min", "maximum": "max"}.items():
        assert ours[key] == pytest.approx(theirs[name], **tolerance)
    for key in ("mean", "median", "std"):
        assert ours[key] == pytest.approx(theirs[key], **tolerance)


def test_it_agrees_with_evo(tmp_path):
    """Without lever arm and turn, at the given offset; the reference has a pose at each time of the path."""
    path = filmed_path(noise_m=0.03, noise_deg=2.0, seed=4, start_s=1.5031)
    estimate = tum_file(tmp_path, "slam", path.time_s, path.position_m[:, 0], path.orientation_wxyz[:, 0])
    reference = tum_file(tmp_path, "vicon", *recording(clock_s=0.25))
    options = ("--no-lever-arm", "--no-turn")
    found = run(estimate, reference, "--offset", 0.25, *options)
    position, rotation = evo_ape(estimate, reference, 0.25)
    same(found["distance_m"], position, abs=1e-7)
    same(found["angle_deg"], rotation, abs=1e-5)
    assert found["distance_m"]["count"] == path.num_frames
    # The search finds an offset that is as good.
    searched = run(estimate, reference, *options)
    assert searched["offset_s"] == pytest.approx(0.25, abs=0.1 / FPS)
    assert searched["distance_m"]["mean"] <= found["distance_m"]["mean"]


@pytest.mark.real
def test_it_agrees_with_evo_on_a_real_flight_of_a_camera():
    """evo takes the nearest pose of the reference, within 10 ms, where psotrack interpolates."""
    folder = published("MichaelGrupp/evo") / "test/data"
    estimate, reference = (folder / f"freiburg1_xyz-{name}.txt" for name in ("rgbdslam", "groundtruth"))
    found = run(estimate, reference, "--offset", 0, "--no-lever-arm", "--no-turn")
    position, rotation = evo_ape(estimate, reference)
    for ours, theirs in ((found["distance_m"], position), (found["angle_deg"], rotation)):
        assert [ours["mean"], ours["median"]] == pytest.approx([theirs["mean"], theirs["median"]], rel=0.02)
    # The clocks of the benchmark are synchronous.
    searched = run(estimate, reference, "--max-offset", 1)
    assert abs(searched["offset_s"]) < 3 * searched["offset_std_s"]


def test_the_axes_of_a_body(tmp_path):
    """Roll, pitch and yaw of a body that is turned about its own axes, by SciPy's Euler angles."""
    path = filmed_path()
    yawed = Rotation.from_quat(path.orientation_wxyz[:, 0], scalar_first=True)
    turned = Rotation.from_euler("Z", 3.0, degrees=True) * yawed
    wxyz = turned.as_quat(scalar_first=True)
    estimate = tum_file(tmp_path, "slam", path.time_s, path.position_m[:, 0], wxyz)
    reference = tum_file(tmp_path, "vicon", *recording())
    found = run(estimate, reference, "--offset", 0, "--no-lever-arm", "--no-turn", "--axes", "body")
    assert found["yaw_deg"]["mean"] == pytest.approx(3.0, abs=1e-3)
    assert found["roll_deg"]["maximum"] < 1e-3


def test_several_drones_need_a_name(files, tmp_path):
    table, vicon, _ = files
    (tmp_path / "both").mkdir()
    for name in ("a", "b"):
        (tmp_path / "both" / f"{name}.tum").write_text(vicon.read_text())
    write_trajectories(tmp_path / "two.csv", read_tracks(tmp_path / "both"))
    with pytest.raises(InputError, match="expected a drone dron1, found a, b; name one with --drone"):
        run(table, tmp_path / "two.csv")

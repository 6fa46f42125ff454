"""`psotrack track` on a small simulated sequence: files, columns and keys of the contract, and what options do."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from evaluation_flights import ERROR_KEYS
from helpers import Output, assert_refused, environment_without_jax_settings, made_once

from psotrack import cli
from psotrack.settings import TrackSettings, setting_names
from psotrack.simulation import SimulationSettings, simulate
from psotrack.trajectories import write_ambiguity

COLUMNS = [
    *("frame", "time_s", "drone", "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s"),
    *("fitness", "num_cameras", "status"),
    *("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"),
    *("rel_cov_xx", "rel_cov_xy", "rel_cov_xz", "rel_cov_yy", "rel_cov_yz", "rel_cov_zz"),
]
#: Keys of the record beside the tracks, of every method; the contract promises more, where they have a meaning.
RECORD = {
    *("rate_hz", "camera_times", "settings", "seed", "versions", "device", "input_keys", "start", "volume"),
    *("drones", "arrivals", "points", "left_out", "ellipsoid", "explained", "knocks"),
    *("camera_errors", "encounters"),
    *("seconds", "real_time_factor", "real_time_factor_running"),
}
NUM_FRAMES = 12
#: Cameras of the small sequence. Drones of a dozen pixels are found only if many cameras see them.
CAMERAS = [f"cam{i}" for i in range(1, 9)]
LINES = ("--method", "projection-lines")


def make_small(folder):
    settings = SimulationSettings(num_frames=NUM_FRAMES, scale=0.35, masks=False, onboard=False)
    simulate("S02_D4_A", folder, settings, jobs=1)


#: A folder with the small sequence, which no test changes.
data = made_once("sequence_of_track", make_small, "Simulated_Data/S02_D4_A")


@pytest.fixture
def sequence(data, tmp_path):
    """A copy of the small sequence, which a test may change."""
    return shutil.copytree(data, tmp_path / "S02_D4_A")


@pytest.fixture
def run(data, monkeypatch, run_psotrack):
    """Runs `psotrack` with some arguments; silhouettes are shared by the tests of this file."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(data.parents[1] / "cache"))
    return run_psotrack


def words(sequence, out, *more):
    """Arguments of a quick `track`: the small sequence has large pixels."""
    return ["track", sequence, "--out", out, "--reduction", 2, "--particles", 20, "--iterations", 15, *more]


@pytest.fixture
def track(run, data, tmp_path):
    """Runs a quick `track` that must succeed: the table and the record."""

    def track(name, *more, sequence=data):
        run(*words(sequence, tmp_path / name, *more)).ended()
        return read(tmp_path / name)

    return track


def read(path):
    table = pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path)
    assert list(table.columns) == COLUMNS
    return table, json.loads(path.with_suffix(".json").read_text())


def assert_record_of_contract(record, num_drones):
    assert set(record) >= RECORD
    stages = {"decode", "foreground", "silhouettes", "volume", "track", "compile", "finish", "total"}
    assert set(record["seconds"]) == stages
    assert [drone["drone"] for drone in record["drones"]] == [*range(num_drones)]
    for drone in record["drones"]:
        assert set(drone) == {"drone", "size_m", "size_std_m", "size_frames", "fill"}
        assert len(drone["size_m"]) == len(drone["size_frames"]) == 3
        assert drone["size_std_m"] == [None, None, None]
        assert drone["fill"] is None
    assert set(record["start"]) == {"position_m", "velocity_m_s", "size_m", "num_cameras"}
    for values in record["start"].values():
        assert len(values) == num_drones
    assert set(record["camera_errors"]) >= {"cameras", "turn_deg", "clock_s", "fading_share", "fading_time_s"}
    assert record["arrivals"] == record["encounters"] == []
    assert len(record["points"]) == num_drones


@pytest.mark.slow
def test_the_contract_from_videos_to_errors(run, data, tmp_path):
    tracks, config, log = tmp_path / "tracks.csv", tmp_path / "run.toml", tmp_path / "run.log"
    done = run(*words(data, tracks, "--seed", 3, "--save-config", config, "--log", log)).ended()
    assert done.err == ""
    # The sentence, and a table with the four drones.
    sentence, *table = done.out.splitlines()
    assert sentence.startswith(f"{tracks}: 4 drones, {NUM_FRAMES} frames")
    assert [line[:1] for line in table[2:]] == ["0", "1", "2", "3"]
    said = log.read_text()
    assert f" info track: {NUM_FRAMES} of {NUM_FRAMES} in " in said
    assert said.endswith(f"{sentence}\n")

    table, record = read(tracks)
    assert len(table) == NUM_FRAMES * 4
    assert set(table["frame"]) == set(range(NUM_FRAMES))
    assert set(table["status"]) <= {"tracked", "coasting", "lost"}
    np.testing.assert_allclose(table["time_s"], table["frame"] / 25)
    pairs = pd.read_csv(tmp_path / "tracks.ambiguity.csv")
    assert list(pairs.columns) == ["frame", "time_s", "drone", "other", "ambiguity"]
    assert record["seed"] == 3
    assert record["settings"]["swarm"]["particles"] == 20
    assert_record_of_contract(record, 4)
    # All of the program's time counts, and less of it without the start and the compilation.
    total_s = NUM_FRAMES / 25 / record["real_time_factor"]
    assert total_s == pytest.approx(record["seconds"]["total"], rel=0.02)
    assert record["real_time_factor_running"] >= record["real_time_factor"] > 0
    assert set(record["input_keys"]) == set(CAMERAS)
    assert {"python", "jax", "numpy", "psotrack"} <= set(record["versions"])
    assert record["device"]["platform"]

    plot, report = tmp_path / "p.png", tmp_path / "out.json"
    shown = run("evaluate", tracks, data, "--json", report, "--plot", plot).ended()
    assert f"{plot}: paths" in shown.out
    assert plot.read_bytes().startswith(b"\x89PNG")
    errors = json.loads(report.read_text())
    assert errors.keys() == ERROR_KEYS
    assert errors["frames"] == NUM_FRAMES - 1, "the reference has no pose in frame 0"
    assert errors["drones"] == 4
    # A pixel of this small image is 2 to 3 cm at the drones, and a silhouette cell two pixels.
    assert errors["mean_error_m"] < 0.15

    # The saved settings give the same tracks, in each format; what is typed counts more.
    again = tmp_path / "again.parquet"
    assert run("track", data, "--config", config, "--out", again, "--quiet") == Output(0, "", "")
    same, _ = read(again)
    # The digits in the file are exact, but pandas 2 reads numbers with an error of a few units in the last place.
    places = ["x_m", "y_m", "z_m"]
    np.testing.assert_allclose(same[places], table[places], rtol=1e-14)
    other = run("track", data, "--config", config, "--out", tmp_path / "o.csv", "--json", "-", "--seed", 4)
    assert json.loads(other.out)["seed"] == 4
    assert (tmp_path / "o.csv").read_bytes() != tracks.read_bytes()


@pytest.mark.slow
def test_options_choose_the_start_the_drones_the_cameras_and_the_frames(track, sequence, tmp_path):
    """The paper's baseline, from earlier tracks; the video of a camera that is left out may be missing."""
    first, _ = track("a.csv", "--init", "truth")
    assert set(first["drone"]) == {0, 1, 2, 3}
    smoothed, _ = track("s.csv", "--init", "truth", "--smooth")
    for column in ("cov_xx", "cov_yy", "cov_zz"):
        assert smoothed[column].mean() < first[column].mean()
    same = ["frame", "drone", "status"]
    pd.testing.assert_frame_equal(smoothed[same], first[same])
    (sequence / "cam8i_s.avi").unlink()
    seven = CAMERAS[:7]
    chosen = ("--cameras", ",".join(seven), "--frames", 11, "--swarm", "joint", "--score", "hard")
    table, record = track("b.csv", "--init", tmp_path / "a.csv", "--drones", 2, *chosen, sequence=sequence)
    assert set(table["drone"]) == {0, 1}
    assert table["frame"].max() == 10
    assert record["cameras"] == seven
    assert record["settings"]["swarm"]["kind"] == "joint"
    assert record["settings"]["score"]["kind"] == "hard"


@pytest.mark.slow
def test_drones_that_are_not_found_do_not_stop_tracking_and_are_said(track, caplog):
    table, _ = track("t.csv", "--drones", 7)
    seen = table["drone"].nunique()
    assert seen < 7
    assert f"--drones 7: only {seen} drones were seen; the tracks have no others" in caplog.messages


def assert_near(run, tracks, sequence):
    """Assert that all drones are followed, to 5 cm."""
    shown = run("evaluate", tracks, sequence, "--json", "-")
    errors = json.loads(shown.out)
    assert errors["id_switches"] == 0
    assert errors["missed_rate"] == 0
    assert errors["mean_error_m"] < 0.05


@pytest.mark.slow
def test_projection_lines(run, track, data, tmp_path):
    """The columns are the swarm's columns, and the sequence's own detections are the files in its folder."""
    table, record = track("own.csv", *LINES)
    assert len(table) == 4 * NUM_FRAMES
    track("folder.csv", *LINES, "--detections", data / "dl_data")
    assert (tmp_path / "own.csv").read_bytes() == (tmp_path / "folder.csv").read_bytes()
    assert {point["middle_of"] for point in record["points"]} == {"box"}
    assert record["settings"]["method"] == "projection-lines"
    assert record["ellipsoid"] == "the middle of the box"
    assert sorted(record["input_keys"]) == CAMERAS
    assert_record_of_contract(record, 4)
    # What is stated of the body's origin widens the ellipsoid, which then is that of the origin.
    wide, record = track("wide.csv", *LINES, "--origin-uncertainty", "0.03")
    assert record["ellipsoid"] == "the body's origin"
    np.testing.assert_allclose(wide.cov_xx - table.cov_xx, 0.03**2, rtol=1e-3)
    np.testing.assert_allclose(wide.cov_xy, table.cov_xy)
    np.testing.assert_allclose(wide.rel_cov_xx, table.rel_cov_xx)
    # Most of the error is the distance from the drones' origins to the middles of their boxes.
    assert_near(run, tmp_path / "own.csv", data)
    # A drone that no detection shows: its size is null, because JSON has no NaN; the command failed.
    (tmp_path / "start.csv").write_text("frame,drone,x_m,y_m,z_m\n0,0,0,0,2\n0,1,3.5,-3.5,0.5\n")
    _, record = track("t.csv", *LINES, "--init", tmp_path / "start.csv")
    sizes_m = [drone["size_m"] for drone in record["drones"]]
    assert [None, None, None] in sizes_m


@pytest.mark.slow
def test_fused_uses_a_camera_that_has_detections_and_no_video(run, track, sequence, tmp_path):
    (sequence / "cam3i_s.avi").unlink()
    table, record = track("t.csv", "--method", "fused", sequence=sequence)
    assert len(table) == 4 * NUM_FRAMES
    names = {*CAMERAS, *(f"detections of {camera}" for camera in CAMERAS)}
    assert set(record["input_keys"]) == names - {"cam3"}
    # The middles of silhouette and box are within the drone, which is some centimetres high.
    for point in record["points"]:
        assert point["middle_of"] == "silhouette"
        assert 0 < abs(point["box_off_m"][2]) < 0.1
        assert point["box_off_std_m"][2] > 0
    assert_near(run, tmp_path / "t.csv", sequence)


@pytest.mark.slow
def test_without_detections_blobs_take_their_place(run, sequence, tmp_path):
    shutil.rmtree(sequence / "dl_data")
    own = words(sequence, tmp_path / "t.csv", *LINES, "--detections", "yolo")
    assert_refused(lambda: run(*own), "dl_data", unchanged=tmp_path)
    result = run(*words(sequence, tmp_path / "t.csv", *LINES, "--frames", 11)).ended()
    assert "blobs of its silhouettes take their place" in result.out
    said = run(
        *words(sequence, tmp_path / "said.csv", *LINES, "--frames", 11, "--detections", "blobs")
    ).ended()
    assert "take their place" not in said.out
    assert (tmp_path / "said.csv").read_bytes() == (tmp_path / "t.csv").read_bytes()


def test_ambiguous_pairs_have_a_row_in_each_frame_in_which_they_are(tmp_path):
    pairs = np.array([[0, 1], [0, 2]])
    ambiguity = np.array([[0.0, 0.25], [0.5, 0.0]])
    write_ambiguity(tmp_path / "a.csv", np.array([0.0, 0.04]), pairs, ambiguity)
    rows = pd.read_csv(tmp_path / "a.csv")
    assert rows["time_s"].tolist() == [0.0, 0.04]
    assert rows[["frame", "drone", "other"]].to_numpy().tolist() == [[0, 0, 2], [1, 0, 1]]
    assert rows["ambiguity"].tolist() == [0.25, 0.5]


def test_command_line_defaults_are_the_defaults_of_the_settings():
    """Every setting has an option, whose default is the setting's."""
    defaults = {option.name: option.default for option in cli.cli.commands["track"].params}
    for name in setting_names():
        default = TrackSettings()
        for part in name.split("."):
            default = getattr(default, part)
        assert defaults[name.replace(".", "__")] == default, name


@pytest.mark.nightly
def test_a_second_run_uses_the_stored_compiled_program(start_python, data, tmp_path):
    stored = []
    for name in ("first.csv", "second.csv"):
        command = [*words(data, tmp_path / name), "--cache", tmp_path / "cache"]
        process = start_python("-m", "psotrack", *command, env=environment_without_jax_settings())
        process.communicate()
        assert process.returncode == 0
        compiled = (tmp_path / "cache" / "compiled").glob("jit_track-*-cache")
        # A program that is stored again is another file.
        stored.append({path.name: path.stat().st_ino for path in compiled})
    assert stored[0]
    assert stored[0] == stored[1]
    assert (tmp_path / "first.csv").read_bytes() == (tmp_path / "second.csv").read_bytes()

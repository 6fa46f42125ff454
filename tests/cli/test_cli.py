"""The command line: output files and columns of the contract, and one clear line for every wrong input."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from helpers import Output, environment_without_jax_settings

from psotrack import cli
from psotrack.recordings import VideoWriter, probe, read_frames

COLUMNS = [
    *("frame", "time_s", "drone", "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s"),
    *("fitness", "num_cameras", "status"),
    *("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"),
    *("rel_cov_xx", "rel_cov_xy", "rel_cov_xz", "rel_cov_yy", "rel_cov_yz", "rel_cov_zz"),
]
#: Keys of the errors as JSON, which the contract promises.
ERRORS = [
    *("frames", "drones", "mean_error_m", "median_error_m", "std_error_m", "p95_error_m", "max_error_m"),
    *("missed_rate", "id_switches", "mota", "motp_m", "idf1", "matched_mean_error_m"),
    *("offset_removed_mean_error_m", "hota", "deta", "assa", "loca"),
    *("gospa_m", "gospa_localisation_m", "gospa_missed_m", "gospa_false_m"),
    *("ate_rmse_m", "ate_aligned_rmse_m", "rpe_1s_rmse_m", "rpe_1s_rotation_rmse_deg"),
    *("inside_90_rate", "mean_nees", "offset_removed_inside_90_rate", "offset_removed_mean_nees"),
    "per_drone",
]
#: Keys of the record beside the tracks, of every method; the contract promises more, where they have a meaning.
RECORD = {
    *("rate_hz", "camera_times", "settings", "seed", "versions", "device", "input_keys", "start", "volume"),
    *("drones", "arrivals", "points", "left_out", "ellipsoid", "camera_errors", "encounters"),
    *("seconds", "real_time_factor", "real_time_factor_running"),
}
NUM_FRAMES = 12
#: Cameras of the small sequence except the last one. Drones of a dozen pixels are found only if many cameras see them.
CAMERAS = ",".join(f"cam{i}" for i in range(1, 8))


Run = Callable[..., Output]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small sequence, its silhouettes, and nothing else."""
    root = tmp_path_factory.mktemp("data")
    command = ["simulate", "S02_D4_A", "--out", str(root), "--scale", "0.35", "--frames", str(NUM_FRAMES)]
    command += ["--no-onboard"]
    subprocess.run([sys.executable, "-m", "psotrack", *command, "--quiet"], check=True)
    return root


@pytest.fixture
def sequence(data: Path, tmp_path: Path) -> Path:
    """A copy of the small sequence, which a test may change."""
    return shutil.copytree(data / "Simulated_Data" / "S02_D4_A", tmp_path / "S02_D4_A")


@pytest.fixture
def run(data: Path, monkeypatch: pytest.MonkeyPatch, run_psotrack: Run) -> Run:
    """Runs `psotrack` with some arguments; silhouettes are shared by the tests of this file."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(data / "cache"))
    return run_psotrack


def track(sequence: Path, out: Path, *more: object) -> list[object]:
    """Arguments of a quick `track`: the small sequence has large pixels."""
    return ["track", sequence, "--out", out, "--reduction", 2, "--particles", 20, "--iterations", 15, *more]


def assert_one_line(result: Output, *words: str) -> None:
    assert result.code == 2, result
    assert result.out == ""
    assert result.err.count("\n") == 1, result.err
    assert result.err.startswith("psotrack: ")
    for word in words:
        assert word in result.err, result.err


def assert_record_of_contract(record: dict[str, Any], num_drones: int) -> None:
    assert set(record) >= RECORD
    assert set(record["seconds"]) == {"decode", "foreground", "track", "compile", "finish", "total"}
    assert [drone["drone"] for drone in record["drones"]] == [*range(num_drones)]
    for drone in record["drones"]:
        assert set(drone) == {"drone", "size_m", "size_std_m", "size_frames", "fill"}
        assert len(drone["size_m"]) == len(drone["size_frames"]) == 3
        assert (drone["size_std_m"], drone["fill"]) == ([None] * 3, None)
    assert set(record["start"]) == {"position_m", "velocity_m_s", "size_m", "num_cameras"}
    assert {len(values) for values in record["start"].values()} == {num_drones}
    assert set(record["camera_errors"]) >= {"cameras", "turn_deg", "clock_s", "fading_share", "fading_time_s"}
    assert (record["arrivals"], record["encounters"]) == ([], [])
    assert len(record["points"]) == num_drones


def rewrite_video(path: Path, *, frames: int | None = None, size_wh: tuple[int, int] | None = None) -> None:
    """Replace a video by a video with fewer frames or a smaller image."""
    video = probe(path)
    images = list(read_frames(video))[:frames]
    width, height = size_wh or video.image_size_wh
    path.unlink()
    with VideoWriter(path, video.fps, (width, height)) as writer:
        for image in images:
            writer.write(np.ascontiguousarray(image[:height, :width]))


@pytest.mark.slow
def test_the_contract_from_videos_to_errors(run: Run, sequence: Path, tmp_path: Path) -> None:
    tracks, errors_path = tmp_path / "tracks.csv", tmp_path / "out.json"
    assert run(*track(sequence, tracks, "--seed", 3)).code == 0
    table = pd.read_csv(tracks)
    assert list(table.columns) == COLUMNS
    assert len(table) == NUM_FRAMES * 4
    assert set(table["frame"]) == set(range(NUM_FRAMES))
    assert set(table["status"]) <= {"tracked", "coasting", "lost"}
    np.testing.assert_allclose(table["time_s"], table["frame"] / 25)

    record = json.loads(tracks.with_suffix(".json").read_text())
    assert record["seed"] == 3
    assert record["settings"]["swarm"]["particles"] == 20
    assert_record_of_contract(record, 4)
    # All of the program's time counts, and less of it without the start and the compilation.
    total_s = NUM_FRAMES / 25 / record["real_time_factor"]
    assert total_s == pytest.approx(record["seconds"]["total"], rel=0.02)
    assert record["real_time_factor_running"] > record["real_time_factor"] > 0
    assert set(record["input_keys"]) == {f"cam{i}" for i in range(1, 9)}
    assert {"python", "jax", "numpy", "psotrack"} <= set(record["versions"])
    assert record["device"]["platform"]

    shown = run("evaluate", tracks, sequence, "--json", errors_path, "--plot", tmp_path / "p.png")
    assert (shown.code, f"{tmp_path / 'p.png'}: paths" in shown.out) == (0, True)
    errors = json.loads(errors_path.read_text())
    assert sorted(errors) == sorted(ERRORS)
    assert errors["frames"] == NUM_FRAMES - 1, "the reference has no pose in frame 0"
    assert errors["drones"] == 4
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    # A pixel of this small image is 2 to 3 cm at the drones, and a silhouette cell two pixels.
    assert errors["mean_error_m"] < 0.15


@pytest.mark.slow
def test_parquet_and_csv_have_the_same_content(run: Run, sequence: Path, tmp_path: Path) -> None:
    for suffix in ("csv", "parquet"):
        assert run(*track(sequence, tmp_path / f"{suffix}" / f"tracks.{suffix}")).code == 0
    csv = pd.read_csv(tmp_path / "csv/tracks.csv")
    parquet = pd.read_parquet(tmp_path / "parquet/tracks.parquet")
    assert list(parquet.columns) == COLUMNS
    # The digits in the file are exact, but pandas 2 reads numbers with an error of a few units in the last place.
    np.testing.assert_allclose(csv[["x_m", "y_m", "z_m"]], parquet[["x_m", "y_m", "z_m"]], rtol=1e-14)


@pytest.mark.slow
def test_a_second_call_reads_the_stored_silhouettes(run: Run, sequence: Path, tmp_path: Path) -> None:
    first = run("detect", "--silhouettes", sequence, "--reduction", 2, "--json", "-")
    again = run("detect", "--silhouettes", sequence, "--reduction", 2, "--json", "-")
    assert first.code == again.code == 0
    assert json.loads(again.out)["keys"] == json.loads(first.out)["keys"]
    assert json.loads(again.out)["seconds"] == {"decode": 0.0, "foreground": 0.0}


@pytest.mark.slow
def test_quiet_prints_nothing_and_bars_need_a_terminal(run: Run, sequence: Path, tmp_path: Path) -> None:
    tracks = tmp_path / "tracks.csv"
    assert run(*track(sequence, tracks, "--quiet")) == Output(0, "", "")
    loud = run("evaluate", tracks, sequence)
    assert loud.code == 0
    assert "MOTA" in loud.out
    assert loud.err == ""


@pytest.mark.slow
def test_a_saved_config_gives_the_same_tracks_and_a_log_says_what_was_done(
    run: Run, sequence: Path, tmp_path: Path
) -> None:
    tracks, config, log = tmp_path / "tracks.csv", tmp_path / "run.toml", tmp_path / "run.log"
    first = run(*track(sequence, tracks, "--seed", 5, "--save-config", config, "--log", log))
    assert first.code == 0
    lines = first.out.splitlines()
    # The sentence, and a table with the four drones.
    assert lines[0].startswith(f"{tracks}: 4 drones, {NUM_FRAMES} frames")
    assert lines[1].split()[:2] == ["drone", "seen"]
    assert [line.split()[0] for line in lines[3:]] == ["0", "1", "2", "3"]
    assert max(map(len, lines[1:])) <= 80
    said = log.read_text()
    assert f" info track: {NUM_FRAMES} of {NUM_FRAMES} in " in said
    assert said.splitlines()[-1].endswith(lines[0])

    assert_one_line(run(*track(sequence, tracks, "--config", config)), "tracks.csv", "--force")
    again = run(
        "track", sequence, "--config", config, "--out", tmp_path / "again.csv", "--json", "-", "--causal"
    )
    assert (again.code, json.loads(again.out)["seed"]) == (0, 5)
    assert (tmp_path / "again.csv").read_bytes() != tracks.read_bytes(), "what is typed is ignored"
    assert run("track", sequence, "--config", config, "--out", tmp_path / "same.csv").code == 0
    assert (tmp_path / "same.csv").read_bytes() == tracks.read_bytes()


@pytest.mark.slow
def test_init_from_truth_and_from_tracks(run: Run, sequence: Path, tmp_path: Path) -> None:
    assert run(*track(sequence, tmp_path / "a.csv", "--init", "truth")).code == 0
    assert run(*track(sequence, tmp_path / "b.csv", "--init", tmp_path / "a.csv", "--drones", 2)).code == 0
    first, second = pd.read_csv(tmp_path / "a.csv"), pd.read_csv(tmp_path / "b.csv")
    assert set(first["drone"]) == {0, 1, 2, 3}
    assert set(second["drone"]) == {0, 1}


@pytest.mark.slow
def test_the_paper_baseline_runs(run: Run, sequence: Path, tmp_path: Path) -> None:
    result = run(*track(sequence, tmp_path / "t.csv", "--swarm", "joint", "--score", "hard"))
    assert result.code == 0
    settings = json.loads((tmp_path / "t.json").read_text())["settings"]
    assert (settings["swarm"]["kind"], settings["score"]["kind"]) == ("joint", "hard")


@pytest.mark.slow
def test_smoothed_tracks_have_smaller_covariances(run: Run, sequence: Path, tmp_path: Path) -> None:
    for name, more in (("filtered", ()), ("smoothed", ("--smooth",))):
        assert run(*track(sequence, tmp_path / f"{name}.csv", *more)).code == 0
    filtered, smoothed = (pd.read_csv(tmp_path / f"{name}.csv") for name in ("filtered", "smoothed"))
    columns = ["cov_xx", "cov_yy", "cov_zz"]
    assert smoothed[columns].sum(axis=1).mean() < filtered[columns].sum(axis=1).mean()
    pd.testing.assert_frame_equal(
        smoothed[["frame", "drone", "status"]], filtered[["frame", "drone", "status"]]
    )


@pytest.mark.slow
def test_ambiguous_pairs_are_written_beside_the_tracks(run: Run, sequence: Path, tmp_path: Path) -> None:
    from psotrack.trajectories import write_ambiguity

    tracks = tmp_path / "t.csv"
    assert run(*track(sequence, tracks)).code == 0
    table = pd.read_csv(tmp_path / "t.ambiguity.csv")
    assert list(table.columns) == ["frame", "time_s", "drone", "other", "ambiguity"]
    record = json.loads((tmp_path / "t.json").read_text())
    assert [drone["drone"] for drone in record["drones"]] == [0, 1, 2, 3]
    # The three files belong together: if one of them exists, none is written.
    (tmp_path / "t.csv").unlink()
    assert_one_line(run(*track(sequence, tracks)), "t.json", "--force")
    pairs, ambiguity = np.array([[0, 1], [0, 2]]), np.array([[0.0, 0.25], [0.5, 0.0]])
    write_ambiguity(tmp_path / "a.csv", np.array([0.0, 0.04]), pairs, ambiguity)
    written = pd.read_csv(tmp_path / "a.csv")
    assert written.to_dict("list") == {
        "frame": [0, 1],
        "time_s": [0.0, 0.04],
        "drone": [0, 0],
        "other": [2, 1],
        "ambiguity": [0.25, 0.5],
    }


@pytest.mark.slow
# 12 frames are too few for a first row of --causal.
@pytest.mark.parametrize("more", [(), ("--method", "projection-lines"), ("--causal",)])
def test_drones_that_are_not_found_do_not_stop_tracking_and_are_said(
    run: Run, sequence: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, more: tuple[str, ...]
) -> None:
    result = run(*track(sequence, tmp_path / "t.csv", "--drones", 7, *more))
    assert result.code == 0
    seen = pd.read_csv(tmp_path / "t.csv")["drone"].nunique()
    assert seen < 7
    assert f"--drones 7: only {seen} drones were seen; the tracks have no others" in caplog.messages


@pytest.mark.slow
def test_projection_lines_from_the_sequence_a_folder_and_blobs(
    run: Run, sequence: Path, tmp_path: Path
) -> None:
    """The columns are the swarm's columns, and the sequence's own detections are the files in its folder."""
    tracks = [tmp_path / f"{name}.csv" for name in ("own", "folder", "blobs")]
    for path, more in zip(
        tracks,
        # In images of this size, the blobs of a white drone before a white wall fall into parts: a fifth track.
        ((), ("--detections", sequence / "dl_data"), ("--detections", "blobs", "--drones", 4)),
        strict=True,
    ):
        result = run(*track(sequence, path, "--method", "projection-lines", *more))
        assert result.code == 0, result
        assert list(pd.read_csv(path).columns) == COLUMNS
        assert len(pd.read_csv(path)) == 4 * NUM_FRAMES
    assert tracks[0].read_bytes() == tracks[1].read_bytes() != tracks[2].read_bytes()
    together = tmp_path / "together.csv"
    assert run(*track(sequence, together, "--method", "fused")).code == 0
    assert len(pd.read_csv(together)) == 4 * NUM_FRAMES
    keys = json.loads(together.with_suffix(".json").read_text())["input_keys"]
    assert set(keys) == {name for i in range(1, 9) for name in (f"cam{i}", f"detections of cam{i}")}
    points = json.loads(together.with_suffix(".json").read_text())["points"]
    assert {point["middle_of"] for point in points} == {"silhouette"}
    # The middles of silhouette and box are within the drone, which is some centimetres high.
    assert all(0 < abs(point["box_off_m"][2]) < 0.1 and point["box_off_std_m"][2] > 0 for point in points)
    record = json.loads(tracks[0].with_suffix(".json").read_text())
    assert [point["middle_of"] for point in record["points"]] == ["box"] * 4
    assert record["settings"]["method"] == "projection-lines"
    assert record["ellipsoid"] == "the middle of the box"
    assert_record_of_contract(record, 4)
    # What is stated of the body's origin widens the ellipsoid, which then is that of the origin.
    wide = tmp_path / "wide.csv"
    words = ("--method", "projection-lines", "--origin-uncertainty", "0.03")
    assert run(*track(sequence, wide, *words)).code == 0
    assert json.loads(wide.with_suffix(".json").read_text())["ellipsoid"] == "the body's origin"
    before, after = pd.read_csv(tracks[0]), pd.read_csv(wide)
    np.testing.assert_allclose(after.cov_xx - before.cov_xx, 0.03**2, rtol=1e-3)
    np.testing.assert_allclose(after.cov_xy, before.cov_xy)
    np.testing.assert_allclose(after.rel_cov_xx, before.rel_cov_xx)
    assert sorted(record["input_keys"]) == [f"cam{i}" for i in range(1, 9)]
    evaluated = run("evaluate", tracks[0], sequence, "--json", "-")
    errors = json.loads(evaluated.out)
    assert (errors["id_switches"], errors["missed_rate"]) == (0, 0)
    # Most of the error is the distance from the drones' origins to the middles of their boxes.
    assert errors["mean_error_m"] < 0.05


@pytest.mark.slow
def test_fused_uses_a_camera_that_has_detections_and_no_video(
    run: Run, sequence: Path, tmp_path: Path
) -> None:
    tracks = tmp_path / "tracks.csv"
    (sequence / "cam3i_s.avi").unlink()
    result = run(*track(sequence, tracks, "--method", "fused"))
    assert result.code == 0
    assert "left out" not in result.err
    keys = json.loads(tracks.with_suffix(".json").read_text())["input_keys"]
    assert "detections of cam3" in keys
    assert "cam3" not in keys
    errors = json.loads(run("evaluate", tracks, sequence, "--json", "-").out)
    assert (errors["id_switches"], errors["missed_rate"]) == (0, 0)
    assert errors["mean_error_m"] < 0.05


def test_fused_needs_two_videos(run: Run, sequence: Path, tmp_path: Path) -> None:
    for number in range(2, 9):
        (sequence / f"cam{number}i_s.avi").unlink()
    result = run(*track(sequence, tmp_path / "tracks.csv", "--method", "fused"))
    assert_one_line(
        result, "videos of at least two cameras for --method fused, found cam1", "--method projection-lines"
    )


@pytest.mark.slow
def test_a_drone_that_no_detection_shows_has_no_size_in_the_record(
    run: Run, sequence: Path, tmp_path: Path
) -> None:
    """Its size is null, because JSON has no NaN; the command failed after it had written the tracks."""
    (tmp_path / "start.csv").write_text("frame,drone,x_m,y_m,z_m\n0,0,0,0,2\n0,1,3.5,-3.5,0.5\n")
    result = run(
        *track(sequence, tmp_path / "t.csv", "--method", "projection-lines", "--init", tmp_path / "start.csv")
    )
    assert result.code == 0, result
    assert [None] * 3 in [
        drone["size_m"] for drone in json.loads((tmp_path / "t.json").read_text())["drones"]
    ]


def test_missing_and_empty_detections_are_errors(run: Run, sequence: Path, tmp_path: Path) -> None:
    lines = ("--method", "projection-lines")
    nowhere = run(*track(sequence, tmp_path / "t.csv", *lines, "--detections", tmp_path / "nowhere"))
    assert_one_line(nowhere, "nowhere", "cam1.csv", "no such folder")
    shutil.rmtree(sequence / "dl_data")
    assert_one_line(run(*track(sequence, tmp_path / "t.csv", *lines, "--detections", "yolo")), "dl_data")
    fallen_back = run(*track(sequence, tmp_path / "blobs.csv", *lines, "--frames", 11))
    assert (fallen_back.code, "blobs of its silhouettes take their place" in fallen_back.out) == (0, True)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "cam1i.csv").touch()
    none = run(*track(sequence, tmp_path / "t.csv", *lines, "--detections", tmp_path / "empty"))
    assert_one_line(none, "drones", "none in any frame")


@pytest.mark.slow
def test_cameras_and_frames_can_be_chosen(run: Run, sequence: Path, tmp_path: Path) -> None:
    (sequence / "cam8i_s.avi").unlink()
    result = run(*track(sequence, tmp_path / "t.csv", "--cameras", CAMERAS, "--frames", 11))
    assert result.code == 0
    assert json.loads((tmp_path / "t.json").read_text())["cameras"] == CAMERAS.split(",")
    assert pd.read_csv(tmp_path / "t.csv")["frame"].max() == 10


def test_info_shows_the_content_of_a_sequence(run: Run, sequence: Path) -> None:
    result = run("init", "--show", sequence, "--json", "-")
    assert result.code == 0
    content = json.loads(result.out)
    assert content["drones"] == ["dron1", "dron2", "dron3", "dron4"]
    assert content["cameras"]["cam1"]["frames"] == NUM_FRAMES
    assert run("init", "--show", sequence).out.count("672 x 378") == 8


@pytest.mark.parametrize("command", ["simulate sequence", "detect", "track", "evaluate", "demo", "init"])
def test_help_has_an_example(run: Run, command: str) -> None:
    result = run(*command.split(), "--help")
    assert result.code == 0
    assert re.search(rf"Examples?:\n +psotrack {command.removesuffix(' sequence')} ", result.out)


def test_command_line_defaults_are_the_defaults_of_the_settings() -> None:
    """Every setting has an option, whose default is the setting's."""
    from psotrack.settings import TrackSettings, setting_names

    defaults = {option.name: option.default for option in cli.cli.commands["track"].params}
    for name in setting_names():
        default = TrackSettings()
        for part in name.split("."):
            default = getattr(default, part)
        assert defaults[name.replace(".", "__")] == default, name


@pytest.mark.slow
def test_results_are_not_overwritten_without_force(run: Run, sequence: Path, tmp_path: Path) -> None:
    tracks = tmp_path / "tracks.csv"
    tracks.write_text("precious")
    assert_one_line(run(*track(sequence, tracks)), "tracks.csv", "--force")
    assert tracks.read_text() == "precious"
    assert run(*track(sequence, tracks, "--force")).code == 0
    assert tracks.read_text() != "precious"


def cut_in_half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def spoil_reference(path: Path) -> None:
    lines = path.read_text().splitlines()
    fields = lines[5].split(";")
    lines[5] = ";".join([fields[0], "nan", *fields[2:]])
    path.write_text("\n".join(lines) + "\n")


#: What is done to a file of the sequence, further options of `track`, and words of the message.
BAD: dict[str, tuple[str, Callable[[Path], object], tuple[object, ...], tuple[str, ...]]] = {
    "no such sequence": ("", shutil.rmtree, (), ("S02_D4_A", "found nothing")),
    "a missing video": (
        "cam3i_s.avi",
        Path.unlink,
        ("--cameras", "cam1,cam2,cam3"),
        ("a video", "none for cam3"),
    ),
    "a video that is cut short": ("cam2i_s.avi", cut_in_half, (), ("cam2i_s.avi",)),
    "an empty video": ("cam2i_s.avi", lambda path: path.write_bytes(b""), (), ("cam2i_s.avi",)),
    "videos of different size": (
        "cam5i_s.avi",
        lambda path: rewrite_video(path, size_wh=(400, 200)),
        (),
        ("cam5i_s.avi", "400 x 200", "principal point"),
    ),
    "a calibration that cannot be read": (
        "cameras_calibration.csv",
        lambda path: path.write_text(path.read_text().replace(";", "|")),
        (),
        ("cameras_calibration.csv",),
    ),
    "a missing calibration": ("cameras_calibration.csv", Path.unlink, (), ("cameras_calibration.csv",)),
    "nan in a reference": (
        "dron2_pos_25.csv",
        spoil_reference,
        (),
        ("dron2_pos_25.csv", "line 6", "nan"),
    ),
    "no drones": ("", Path.exists, ("--drones", 0), ("drones", "at least 1", "found 0")),
    "no first positions": ("", Path.exists, ("--init", "start.csv"), ("start.csv",)),
    "an unknown camera": ("", Path.exists, ("--cameras", "cam1,cam9"), ("cam9",)),
    "no camera": ("", Path.exists, ("--cameras", ""), ("names with commas", "found ''")),
}


class TestBadInput:
    """Every error is one line with the name of the file, and an earlier result is not changed."""

    @pytest.mark.parametrize("name", BAD)
    def test_an_earlier_result_is_kept(self, run: Run, sequence: Path, tmp_path: Path, name: str) -> None:
        file, spoil, more, words = BAD[name]
        out = tmp_path / "tracks.csv"
        out.write_text("earlier")
        spoil(sequence / file)
        assert_one_line(run(*track(sequence, out, "--force", *more)), *words)
        assert out.read_text() == "earlier"
        assert sorted(path.name for path in tmp_path.glob(".*")) == []

    def test_broken_detections(self, run: Run, sequence: Path) -> None:
        (sequence / "dl_data" / "cam1i_s.csv").write_text("0,1,2,3,4,2.5,4,0.9\n1,5,6\n")
        assert_one_line(run("init", "--show", sequence), "cam1i_s.csv", "line 2")

    def test_a_marker_twice(self, run: Run, sequence: Path) -> None:
        corners = [5, 0, 0, 5, 0.2, 0, 5, 0.2, -0.2, 5, 0, -0.2]
        header = "id;" + ";".join(f"{axis}{corner}[m]" for corner in range(1, 5) for axis in "xyz")
        row = ";".join(map(str, [7, *corners]))
        (sequence / "aruco_corners.csv").write_text(f"{header}\n{row}\n{row}\n")
        assert_one_line(
            run("init", "--show", sequence), "aruco_corners.csv, line 3", "each marker once, found 7 again"
        )

    def test_a_table_without_positions_is_no_file_of_tracks(
        self, run: Run, sequence: Path, tmp_path: Path
    ) -> None:
        (tmp_path / "t.csv").write_text("frame,drone\n0,1\n")
        assert_one_line(run("evaluate", tmp_path / "t.csv", sequence), "t.csv", "x_m")

    def test_wrong_suffix(self, run: Run, sequence: Path, tmp_path: Path) -> None:
        assert_one_line(run("track", sequence, "--out", tmp_path / "t.xlsx"), ".csv or .parquet", "t.xlsx")

    def test_unknown_scenario(self, run: Run, tmp_path: Path) -> None:
        assert_one_line(run("simulate", "S99", "--out", tmp_path), "S99", "S02_D4_A")

    @pytest.mark.parametrize("setting", [("--scale", 0), ("--frames", 0), ("--frames", 100000)])
    def test_impossible_simulation(self, run: Run, tmp_path: Path, setting: tuple[str, object]) -> None:
        assert_one_line(run("simulate", "S02_D4_A", "--out", tmp_path, *setting), setting[0].strip("-"))
        assert list(tmp_path.iterdir()) == []

    def test_usage_errors_exit_with_2(self, run: Run) -> None:
        result = run("track", "--no-such-flag")
        assert result.code == 2
        assert "no-such-flag" in result.err


@pytest.mark.slow
def test_a_second_run_uses_the_stored_compiled_program(sequence: Path, tmp_path: Path) -> None:
    stored = []
    for name in ("first.csv", "second.csv"):
        command = [*track(sequence, tmp_path / name, "--frames", 12), "--cache", tmp_path / "cache"]
        subprocess.run(
            [sys.executable, "-m", "psotrack", *map(str, command)],
            env=environment_without_jax_settings(),
            check=True,
        )
        compiled = (tmp_path / "cache" / "compiled").glob("jit_track-*-cache")
        # A program that is stored again is another file.
        stored.append({path.name: path.stat().st_ino for path in compiled})
    assert stored[0]
    assert stored[0] == stored[1]
    assert (tmp_path / "first.csv").read_bytes() == (tmp_path / "second.csv").read_bytes()


def test_usage_errors_are_one_line(run: Run) -> None:
    assert_one_line(run("trakc"), "trakc", "track", "psotrack --help")
    assert_one_line(run("track"), "SEQ", "psotrack track --help")
    # Found: options without a default were not asked for, and the command failed later.
    assert_one_line(run("simulate", "fly"), "--device", "psotrack simulate fly --help")
    assert_one_line(run("track", "x", "--out", "y", "--body-offset", "1,2"), "--body-offset", "1,2")


def test_options_that_are_near_are_suggested(run: Run) -> None:
    near = run("track", "x", "--ouut", "y")
    assert_one_line(near, "Did you mean one of: '--out'")
    # The full name of an option of which a part was typed.
    assert_one_line(run("track", "x", "--speed", "4"), "'--max-speed'")


@pytest.mark.slow
def test_a_full_disk_leaves_earlier_results(run: Run, data: Path, sequence: Path, tmp_path: Path) -> None:
    """A limit on the size of files replaces the full disk: every larger write fails.

    The process writes no bytecode, because truncated modules in the cache would break other tests.
    """
    tracks = tmp_path / "tracks.csv"
    arguments = [str(word) for word in track(sequence, tracks)]
    assert run(*arguments).code == 0
    earlier = tracks.read_bytes(), tracks.with_suffix(".json").read_bytes()
    limited = (
        "import resource, sys; sys.dont_write_bytecode = True; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (512, 512)); "
        "from psotrack.cli import main; main()"
    )
    result = subprocess.run(
        [sys.executable, "-c", limited, *arguments, "--force", "--seed", "9"],
        # With the suite's folder of compiled programs, JAX would fail to write there too, and print a warning.
        env=environment_without_jax_settings() | {"PSOTRACK_CACHE": str(data / "cache")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert_one_line(Output(result.returncode, result.stdout, result.stderr), "tracks.csv", "unchanged")
    assert (tracks.read_bytes(), tracks.with_suffix(".json").read_bytes()) == earlier
    assert list(tmp_path.glob(".*")) == []


def test_a_wrong_name_is_refused_before_silhouettes_are_computed(
    run: Run, sequence: Path, tmp_path: Path
) -> None:
    for options, words in (
        (("--search", "psoo"), ("swarm.search", "did you mean pso?")),
        (("--score", "sofd"), ("score.kind", "did you mean soft?")),
        (("--init", "none.csv"), ("none.csv",)),
    ):
        refused = run(*track(sequence, tmp_path / "tracks.csv", *options), "--cache", tmp_path / "cache")
        assert_one_line(refused, *words)
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("more", [(), ("--causal",)])
def test_one_camera_is_refused(run: Run, sequence: Path, tmp_path: Path, more: tuple[str, ...]) -> None:
    refused = run(*track(sequence, tmp_path / "tracks.csv", "--cameras", "cam1", *more))
    assert_one_line(refused, "at least two cameras", "found cam1")


def test_a_plot_that_is_no_png_is_refused(run: Run, sequence: Path, tmp_path: Path) -> None:
    refused = run("evaluate", tmp_path / "tracks.csv", sequence, "--plot", tmp_path / "my.jpg")
    assert_one_line(refused, "--plot", "ends in .png", "my.jpg")


def test_info_refuses_a_video_that_is_cut_short(run: Run, sequence: Path) -> None:
    cut_in_half(sequence / "cam2i_s.avi")
    assert_one_line(run("init", "--show", sequence), "cam2i_s.avi", "can be decoded")


#: Program that runs `psotrack` and presses Ctrl-C when it first opens a file in the folder that is the first argument.
INTERRUPTED = """
import signal, sys

# `nohup` and `&` in scripts start the tests with Ctrl-C ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
folder = sys.argv.pop(1)

def press(event, arguments):
    global folder
    # The command looks whether silhouettes are stored.
    if event == "open" and folder and str(arguments[0]).startswith(folder):
        folder = ""
        signal.raise_signal(signal.SIGINT)

sys.addaudithook(press)
from psotrack.__main__ import main
main()
"""


#: Program that runs `psotrack` and presses Ctrl-C in a callback of the garbage collector, which drops exceptions.
INTERRUPTED_UNHEARD = """
import gc, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)

def press(phase, info):
    if "psotrack.recordings.datasets.dpjait" in sys.modules:
        gc.callbacks.remove(press)
        signal.raise_signal(signal.SIGINT)

gc.callbacks.append(press)
from psotrack.__main__ import main
main()
"""


def test_ctrl_c_in_a_callback_of_the_garbage_collector_ends_the_command(
    sequence: Path, tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_UNHEARD, *map(str, track(sequence, tmp_path / "tracks.csv"))],
        env={**os.environ, "PSOTRACK_CACHE": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert re.fullmatch(r"psotrack: interrupted; .*\n", done.stderr)


def test_ctrl_c_leaves_earlier_results(sequence: Path, tmp_path: Path) -> None:
    tracks, cache = tmp_path / "tracks.csv", tmp_path / "cache"
    tracks.write_text("earlier")
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, *map(str, (cache, *track(sequence, tracks, "--force")))],
        env={**os.environ, "PSOTRACK_CACHE": str(cache)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert re.fullmatch(r"psotrack: interrupted; .*\n", done.stderr)
    assert tracks.read_text() == "earlier"

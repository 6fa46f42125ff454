"""`psotrack onboard fuse` on files: the tracks, the report, and error messages of one line."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from test_inside_out_fusing import recording, remove_poses, remove_positions, rms

from psotrack.cli.onboard.fuse import fuse
from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
from psotrack.inside_out import read_camera_path, write_camera_path
from psotrack.recordings.exchange import export_tracks
from psotrack.trajectories import read_trajectories, write_trajectories


def make_files(folder):
    """Write two camera paths, and tracks that have an identity swap at frame 60; the ground truth."""
    paths, outside, truths = recording(31, 100, num_drones=2, distance_m=1.5)
    outside.position_m[60:, [0, 1]] = outside.position_m[60:, [1, 0]]
    paths["dron1"] = remove_poses(paths["dron1"], slice(20, 30))
    write_trajectories(folder / "tracks.csv", remove_positions(outside, slice(80, 90)))
    write_trajectories(
        folder / "elsewhere.csv", replace(outside, position_m=outside.position_m + np.array([0.0, 50.0, 0.0]))
    )
    write_camera_path(folder / "blind.csv", remove_poses(paths["dron1"], slice(0, 100)), "dron3")
    for name, path in paths.items():
        write_camera_path(folder / f"{name}.csv", path, name)
    return truths


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The folder that `make_files` fills, and the ground truth."""
    folder = tmp_path_factory.mktemp("fuse")
    return folder, make_files(folder)


def run(*words):
    return CliRunner().invoke(fuse, [str(word) for word in words])


def test_tracks_outside_may_have_any_format(files, tmp_path) -> None:
    folder, _ = files
    export_tracks(read_trajectories(folder / "tracks.csv"), "json", tmp_path / "tracks.json")
    inside = (folder / "dron1.csv", folder / "dron2.csv")
    done = [
        run(*inside, tracks, "--out", tmp_path / f"{number}.csv")
        for number, tracks in enumerate((folder / "tracks.csv", tmp_path / "tracks.json"))
    ]
    assert [each.exit_code for each in done] == [0, 0], done[1].output
    assert (tmp_path / "0.csv").read_bytes() == (tmp_path / "1.csv").read_bytes()


def test_files_are_fused_into_tracks_that_other_commands_read(files, tmp_path) -> None:
    folder, truths = files
    out, report = tmp_path / "fused.csv", tmp_path / "report.json"
    done = run(
        folder / "dron1.csv", folder / "dron2.csv", folder / "tracks.csv", "--out", out, "--json", report
    )
    assert done.exit_code == 0, done.output
    assert "dron1: track 0 and track 1" in done.output
    assert "from frame 60: dron1 is track 1 instead of 0" in done.output
    fused = read_trajectories(out)
    assert fused.drones == ("dron1", "dron2")
    for drone, (truth_m, _) in enumerate(truths):
        # In frames without a pose, errors are those of the outside tracks, 7 mm, and of an interpolated orientation.
        assert rms(fused.position_m[:, drone] - truth_m) < 0.005
    assert np.isfinite(fused.covariance_m2).all()
    assert fused.seen.all()
    header, first = out.read_text().splitlines()[:2]
    assert {"qw", "qx", "qy", "qz", "source", "status"} <= set(header.split(","))
    assert first.endswith("both,tracked")
    content = json.loads(report.read_text())
    assert content["point"] == "camera"
    assert [exchange["frame"] for exchange in content["exchanges"]] == [60, 60]
    drone = content["drones"][0]
    # Track 0 is lost from frame 80 to 89, and in these frames it belongs to the second drone.
    assert (drone["frames_both"], drone["frames_inside"], drone["frames_outside"]) == (90, 0, 10)
    assert content["drones"][1]["frames_inside"] == 10
    assert np.allclose(drone["lever_arm_m"], [0.01, 0.03, -0.12], atol=0.005)
    assert len(drone["lever_arm_std_m"]) == 3
    assert drone["offset_s"] is None
    assert drone["inside"]["scale"] > 0


def test_point_offset_and_force_options(files, tmp_path) -> None:
    folder, _ = files
    out = tmp_path / "fused.csv"
    words = (
        folder / "dron2.csv",
        folder / "tracks.csv",
        "--out",
        out,
        "--at",
        "middle",
        "--max-offset",
        "0.5",
    )
    done = run(*words, "--json", "-")
    content = json.loads(done.output)
    assert content["point"] == "middle"
    assert content["others"] == ["0"]
    # Both clocks are the same. The limit is four standard deviations.
    assert abs(content["drones"][0]["offset_s"]) < 4 * content["drones"][0]["offset_std_s"]
    before = out.read_bytes()
    assert run(*words, "-q", "--force").output == ""
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("words", "error", "sentence"),
    [
        (
            ["dron1.csv", "tracks.csv", "--out", "fused.txt"],
            SettingsError,
            "--out: expected a file that ends in .csv",
        ),
        (["dron1.csv", "dron1.csv", "tracks.csv", "--out", "new.csv"], InputError, "a second path of dron1"),
        (["tracks.csv", "tracks.csv", "--out", "new.csv"], InputError, "a camera's path with orientations"),
        (["dron1.csv", "none.csv", "--out", "new.csv"], InputError, "none.csv"),
        (["dron1.csv", "tracks.csv", "--out", "dron2.csv"], OutputError, "pass --force to replace it"),
        (
            ["dron1.csv", "tracks.csv", "--out", "new.csv", "--json", "tracks.csv"],
            OutputError,
            "tracks.csv: expected a path that does not exist yet",
        ),
        (
            ["dron1.csv", "tracks.csv", "--out", "new.csv", "--json", "new.csv"],
            SettingsError,
            "--json: expected another file than --out",
        ),
        (
            ["dron1.csv", "tracks.csv", "--out", "new.csv", "--max-offset", "-1"],
            SettingsError,
            "--max-offset: expected a number above 0, found -1",
        ),
        (
            ["blind.csv", "tracks.csv", "--out", "new.csv"],
            InputError,
            "blind.csv: expected a pose in at least",
        ),
        (
            ["dron1.csv", "blind.csv", "--out", "new.csv"],
            InputError,
            "blind.csv, outside tracks: expected a pos",
        ),
    ],
)
def test_errors_are_one_line(files, words, error, sentence) -> None:
    folder, _ = files
    done = run(*(folder / word if word.endswith((".csv", ".txt")) else word for word in words))
    assert isinstance(done.exception, PsotrackError)
    assert isinstance(done.exception, error)
    assert sentence in str(done.exception).replace(f"{folder}/", "")
    assert "\n" not in str(done.exception)
    assert not (folder / "new.csv").exists()


def test_tracks_of_another_recording_are_refused(files, tmp_path) -> None:
    folder, _ = files
    out = tmp_path / "fused.csv"
    done = run(folder / "dron1.csv", folder / "elsewhere.csv", "--out", out)
    assert isinstance(done.exception, InputError)
    message = str(done.exception)
    assert message.startswith(
        f"{folder / 'elsewhere.csv'}, outside tracks: expected a track within 0.5 m of a path"
    )
    assert re.search(
        r"found none \(the nearest is (4[5-9]|5\d)\.\d\d m away\); .*one recording, one clock", message
    )
    tracks = read_trajectories(folder / "tracks.csv")
    write_trajectories(tmp_path / "later.csv", replace(tracks, time_s=tracks.time_s + 100))
    done = run(folder / "dron1.csv", tmp_path / "later.csv", "--out", out)
    assert isinstance(done.exception, InputError)
    assert re.search(
        r"later.csv: expected times in common with the paths, 0.00 to 3.96 s of dron1, found 100.00 to 103.96 s; .*"
        "--max-offset",
        str(done.exception),
    )
    assert not out.exists()


def test_a_drone_without_a_track_beside_one_with_a_track_is_kept(files, tmp_path) -> None:
    folder, _ = files
    done = run(
        folder / "dron1.csv", folder / "blind.csv", folder / "tracks.csv", "--out", tmp_path / "two.csv"
    )
    assert "dron3: no track, kept as it is" in done.output
    assert "nothing was fused" not in done.output


def test_sources_that_never_see_a_drone_at_the_same_time_are_kept_with_a_note(files, tmp_path) -> None:
    folder, _ = files
    tracks = read_trajectories(folder / "tracks.csv")
    write_trajectories(tmp_path / "first.csv", tracks.at_frames(np.arange(40)))
    path, name = read_camera_path(folder / "dron1.csv")
    write_camera_path(tmp_path / "second.csv", remove_poses(path, slice(0, 60)), name)
    done = run(tmp_path / "second.csv", tmp_path / "first.csv", "--out", tmp_path / "fused.csv")
    assert done.exit_code == 0, done.output
    assert "nothing was fused, because no frame has both a pose and a track" in done.output.splitlines()[-1]


def test_help_shows_examples() -> None:
    shown = run("--help").output
    assert "psotrack onboard fuse dron1.csv dron2.csv tracks.csv --out fused.csv" in shown
    assert "--max-offset SECONDS" in shown

"""The command `psotrack simulate`: the list of scenarios, scenario files, and bad input."""

import json
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner

from psotrack import cli
from psotrack.errors import PsotrackError
from psotrack.recordings.datasets import read_sequence

SMALL = ("--frames", "2", "--scale", "0.1", "--jobs", "1", "--no-onboard", "--quiet")
#: Totals that the paper states for its simulated half: frames of all sequences, and frames times drones.
TOTAL_FRAMES, TOTAL_FLIGHT = (20 * 60 + 3) * 25, (91 * 60 + 25) * 25


def run_simulate(*arguments):
    return CliRunner().invoke(cli.cli, ["simulate", *map(str, arguments)], catch_exceptions=False)


def refusal_message(*arguments):
    """Run a command that must fail, and return its error message, which must be one line."""
    with pytest.raises(PsotrackError) as error:
        run_simulate(*arguments)
    message = str(error.value)
    assert "\n" not in message
    return message


def test_the_list_shows_all_thirteen_scenarios():
    rows = json.loads(run_simulate("--list", "--json", "-").stdout)
    assert [row["name"][:3] for row in rows] == [f"S{number:02d}" for number in range(1, 14)]
    assert sum(row["frames"] for row in rows) == TOTAL_FRAMES
    assert sum(row["frames"] * row["drones"] for row in rows) == TOTAL_FLIGHT
    assert {row["name"]: row["cameras"] for row in rows if row["cameras"] != 8} == {
        "S11_D4": 4,
        "S12_D3": 4,
        "S13_D3": 4,
    }
    assert all(row["markers"] == row["onboard"] == row["name"].endswith("_A") for row in rows)
    # Speeds measured on the dataset: the fast sequences, and the sequences flown by hand.
    speed = {row["name"][:3]: row["mean_speed_m_s"] for row in rows}
    assert all(3.4 <= speed[name] <= 4.0 for name in ("S08", "S09", "S10"))
    assert all(0.25 <= speed[name] <= 0.43 for name in ("S11", "S12", "S13"))
    shown = run_simulate("--list").stdout
    for row in rows:
        size = f"{row['drones']} drones, {row['cameras']} cameras, {row['frames']} frames"
        assert f"{row['name']}: {size}, {row['hall']}" in shown
        assert row["description"] in shown


def test_a_preset_can_be_edited_into_a_new_scenario(tmp_path):
    text = run_simulate("S01_D2_A", "--show").stdout
    assert tomllib.loads(text)["name"] == "S01_D2_A"
    mine = tmp_path / "mine.toml"
    mine.write_text(text.replace('name = "S01_D2_A"', 'name = "MINE"'))
    result = run_simulate("--scenario", mine, "--out", tmp_path, "--json", "-", *SMALL)
    folder = tmp_path / "Simulated_Data" / "MINE"
    assert json.loads(result.stdout) == {"sequence": str(folder)}
    recording = read_sequence(folder).usable()
    assert (len(recording.rig), recording.num_frames, len(recording.truth.drones)) == (8, 2, 2)


def test_fields_are_changed_from_the_command_line(tmp_path):
    changes = ("--set", "image_size_wh=[1280,960]", "--set", "name=OTHER")
    run_simulate("S11_D4", "--out", tmp_path, *changes, *SMALL)
    rig = read_sequence(tmp_path / "Simulated_Data" / "OTHER").rig
    np.testing.assert_array_equal(rig.cameras.image_size_wh, np.tile([128, 96], (4, 1)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--seed", "1"), "simulate: expected the NAME of a scenario or --scenario FILE.toml, found neither"),
        (("S01_D2_A", "--scenario", "x.toml"), "found both"),
        (("S99", "--out", "x"), "scenario: expected one of S01_D2_A"),
        (("S01_D2_A", "--out", "x", "--set", "imaging"), "--set: expected FIELD=VALUE"),
        (("S01_D2_A", "--out", "x", "--set", "imaging.noise=1"), "imaging.noise"),
        (("S01_D2_A", "--out", "x", "--set", "drones[0].model=kite"), "drones[0].model"),
        (("S01_D2_A", "--out", "x", "--set", "cameras=[]"), "cameras"),
        (("S01_D2_A", "--out", "x", "--frames", "501"), "frames: expected 1 to 500"),
        (("--scenario", "missing.toml", "--out", "x"), "missing.toml"),
        (("--scenario", "missing.toml", "--show"), "--show: expected the NAME of a scenario"),
        (("S01_D2_A", "--show", "--set", "fps=50"), "whose file is shown as it is, found fps=50"),
        (("S01_D2_A", "--show", "--restless"), "whose file is shown as it is, found --restless"),
        (("S01_D2_A", "--out", "x", "--set", f"fps={'1' * 5000}"), "fps: expected a number, found "),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refusal_message(*arguments)
    assert not list(tmp_path.iterdir())

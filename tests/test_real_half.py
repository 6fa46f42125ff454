"""The real half of the dataset on a stand-in: one recording through every command that a laboratory would run on it."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from psotrack.cli import cli
from psotrack.simulation import (
    RealFormSettings,
    SimulationSettings,
    replaced,
    scenario,
    simulate,
    write_as_real,
)
from psotrack.simulation.real_form import SERIALS

pytestmark = pytest.mark.slow

#: The clock of the reference is ahead by this: 9 and a fraction of a frame.
OFFSET_S = 0.377
#: Where the drones' own motion tells the offset: to a tenth of a frame.
OFFSET_OFF_S = 0.004


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    recipe = replaced(scenario("S02_D4_A"), {"cameras": "laboratory_corners", "markers": False})
    simulated = simulate(
        recipe, root, SimulationSettings(num_frames=150, scale=0.35, masks=False, onboard=False)
    )
    return write_as_real(simulated, root, RealFormSettings(offset_s=OFFSET_S))


@pytest.fixture(scope="module")
def tracks(recording):
    path = recording.parent / "lines.csv"
    said = run("track", recording, "--out", path, "--method", "projection-lines", "-q")
    assert said.exit_code == 0, said.stderr
    return path


def run(*words):
    return CliRunner().invoke(cli, [*map(str, words)], catch_exceptions=False)


def test_info(recording):
    content = json.loads(run("info", recording, "--json", "-").stdout)
    assert list(content["cameras"]) == list(SERIALS)
    assert content["cameras"][SERIALS[0]]["focal_length_px"] == pytest.approx(0.35 * 1158.7)


def test_doctor_finds_the_clock_of_the_reference_and_nothing_else(recording):
    findings = json.loads(run("doctor", recording, "--json", "-").stdout)["findings"]
    (finding,) = findings
    assert "9 frames (0.36 s) ahead" in json.dumps(finding)


def test_its_offset_is_found_and_taken_out(recording, tracks):
    found = json.loads(run("synchronise", tracks, recording, "--json", "-").stdout)
    assert found["offset_s"] == pytest.approx(OFFSET_S, abs=OFFSET_OFF_S)

    def errors(*arguments):
        return json.loads(run("evaluate", tracks, recording, "--json", "-", *arguments).stdout)

    late, auto, told = errors(), errors("--offset", "auto"), errors("--offset", OFFSET_S)
    assert "reference_offset_s" not in late
    assert told["reference_offset_s"] == OFFSET_S
    assert auto["reference_offset_s"] == found["offset_s"]
    # Drones of 1 m/s are a third of a metre further in 0.377 s.
    assert late["offset_removed_mean_error_m"] > 0.15
    for one in (auto, told):
        assert (one["id_switches"], one["missed_rate"]) == (0, 0.0)
        # A third of full size, four cameras: measured 26 mm.
        assert one["offset_removed_mean_error_m"] < 0.04
        # The cross stands above the body, and the box about all of it.
        assert all(drone["offset_m"][2] < -0.03 for drone in one["per_drone"])


def test_an_offset_that_is_none(recording, tracks):
    from psotrack.errors import SettingsError

    with pytest.raises(SettingsError, match="--offset: expected a number of seconds, or auto, found soon"):
        run("evaluate", tracks, recording, "--offset", "soon")


def test_its_rig_is_adjusted_from_its_drones(recording, tracks):
    words = ("calibrate", "adjust", recording, "--tracks", tracks, "--json", "-")
    cameras = json.loads(run(*words, "--out", recording.parent / "adjusted.toml").stdout)["cameras"]
    assert list(cameras) == list(SERIALS)
    # The rig is right; boxes of a third of full size move it by less than they are off in the room.
    assert max(camera["moved_m"] for camera in cameras.values()) < 0.08
    assert all(np.isfinite(camera["centre_std_m"]).all() for camera in cameras.values())

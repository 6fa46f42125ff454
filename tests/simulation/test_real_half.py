"""A simulated sequence in the layout of the dataset's real half, run through every command that a laboratory uses."""

import json
import re

import pytest
from click.testing import CliRunner
from real_form import SERIALS, write_as_real

from psotrack.cli import cli
from psotrack.simulation import (
    SimulationSettings,
    change_scenario,
    scenario,
    simulate,
)

pytestmark = pytest.mark.slow

#: The reference's clock is ahead of the videos by this time, seconds: 9.4 frames of 25 Hz.
OFFSET_S = 0.377
#: Largest error of the offset that is estimated from the drones' motion, seconds: a tenth of a frame.
OFFSET_TOLERANCE_S = 0.004


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    recipe = change_scenario(scenario("S02_D4_A"), {"cameras": "laboratory_corners", "markers": False})
    simulated = simulate(
        recipe, root, SimulationSettings(num_frames=150, scale=0.35, masks=False, onboard=False)
    )
    return write_as_real(simulated, root, offset_s=OFFSET_S)


@pytest.fixture(scope="module")
def tracks(sequence):
    path = sequence.parent / "lines.csv"
    result = run_command("track", sequence, "--out", path, "--method", "projection-lines", "-q")
    assert result.exit_code == 0, result.stderr
    return path


def run_command(*arguments):
    return CliRunner().invoke(cli, [*map(str, arguments)], catch_exceptions=False)


def test_info(sequence):
    content = json.loads(run_command("init", "--show", sequence, "--json", "-").stdout)
    assert list(content["cameras"]) == list(SERIALS)
    assert content["cameras"][SERIALS[0]]["focal_length_px"] == pytest.approx(0.35 * 1158.7)


def test_doctor_says_how_far_the_reference_is_and_names_nothing_else(sequence):
    (finding,) = json.loads(run_command("doctor", sequence, "--json", "-").stdout)["findings"]
    assert finding["kind"] == "reference"
    # The clock is 9 frames late, and the drones fly at about 1.4 m/s; with tracks, the next test finds the clock.
    found = re.match(r"the reference: it is ([0-9.]+) m from what the cameras see", finding["message"])
    assert found is not None
    assert "`psotrack doctor --tracks`" in finding["remedy"]
    assert 0.36 < float(found[1]) < 0.72


def test_synchronise_finds_the_offset_and_evaluate_removes_it(sequence, tracks):
    found = json.loads(run_command("doctor", sequence, "--tracks", tracks, "--json", "-").stdout)
    assert found["offset_s"] == pytest.approx(OFFSET_S, abs=OFFSET_TOLERANCE_S)

    def errors(*arguments):
        return json.loads(run_command("evaluate", tracks, sequence, "--json", "-", *arguments).stdout)

    late, auto, given = errors(), errors("--offset", "auto"), errors("--offset", OFFSET_S)
    assert "reference_offset_s" not in late
    assert given["reference_offset_s"] == OFFSET_S
    assert auto["reference_offset_s"] == found["offset_s"]
    # Drones at about 1 m/s fly more than a third of a metre in 0.377 s.
    assert late["offset_removed_mean_error_m"] > 0.15
    for found_errors in (auto, given):
        assert (found_errors["id_switches"], found_errors["missed_rate"]) == (0, 0.0)
        # Measured 26 mm with four cameras at a third of the full image size.
        assert found_errors["offset_removed_mean_error_m"] < 0.04
        # The reference is the marker cross above the body; the tracked point is the centre of the whole drone's box.
        assert all(drone["offset_m"][2] < -0.03 for drone in found_errors["per_drone"])


def test_an_invalid_offset_is_refused(sequence, tracks):
    refused = run_command("evaluate", tracks, sequence, "--offset", "soon")
    assert (refused.exit_code, "expected a number of seconds, or auto, found 'soon'" in refused.output) == (
        2,
        True,
    )

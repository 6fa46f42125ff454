"""Settings are refused in one line with the dotted name, however they are made."""

import math

import pytest

from psotrack.errors import SettingsError
from psotrack.settings import SwarmSettings, TrackSettings


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("swarm.particles", 1, "expected a whole number of at least 2, found 1"),
        ("swarm.particles", "50", 'expected a whole number, found "50"'),
        ("bounds_m", (0, 1), r"expected a list of length 6, found \[0, 1\]"),
        ("smooth", "yes", 'expected true or false, found "yes"'),
        ("swarm.partikles", 20, r".*, found swarm\.partikles; did you mean swarm\.particles\?"),
        ("swarm.kind", "both", "expected one of joint, per-drone, found both"),
        ("swarm.kind", 3, "expected text, found 3"),
        ("swarm.inertia", math.inf, "expected finite numbers, found inf"),
        ("drones.body_offset_m", (0.0, math.nan, 0.0), r"expected finite numbers, found \(0.0, nan, 0.0\)"),
        ("drones.size_m", (0.4, 0.4, 0.0), r"expected a number above 0, found \[0.4, 0.4, 0.0\]"),
        ("score.windows", (), r"expected a list of length at least 1, found \[\]"),
        ("motion.max_speed_m_s", math.nan, "expected a number above 0, found NaN"),
        ("status.min_fitness", 1.5, "expected a number of at most 1, found 1.5"),
        ("bounds_m", (0, 1, 0, 1, 2, 1), r"expected x0 < x1, y0 < y1, z0 < z1, found \(0, 1, 0, 1, 2, 1\)"),
        (
            "particles",
            20,
            r"expected the name of a setting, found particles; did you mean swarm\.particles\?",
        ),
    ],
)
def test_a_wrong_setting_is_named(name: str, value: object, message: str) -> None:
    with pytest.raises(SettingsError, match=f"^{name}: {message}$"):
        TrackSettings().changed({name: value})


def test_records_made_in_python_are_checked_as_well() -> None:
    with pytest.raises(SettingsError, match=r"^swarm\.spread_m: expected a number above 0, found 0$"):
        SwarmSettings(spread_m=0)
    with pytest.raises(SettingsError, match=r"^swarm: expected a table, found \"joint\"$"):
        TrackSettings(swarm="joint")

"""What results show in a notebook: well-formed HTML with all drones, escaped names."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
from evaluation_flights import circling_flights
from helpers import cameras_of, ring_rig

from psotrack.evaluation import evaluate
from psotrack.pipeline import TrackedRecording
from psotrack.recordings import FrameTimes, Recording
from psotrack.settings import TrackSettings
from psotrack.tracking.identity import Identities
from psotrack.trajectories import Status, Trajectories, summary_columns

#: Names are text, not tags; viewers of saved notebooks remove style sheets and scripts.
TAGS = {"div", "b", "table", "thead", "tbody", "tr", "th", "td"}


def rows_of(shown: object) -> list[list[str | None]]:
    """Texts in the rows of the tables that a result shows; each tag must be closed in order."""
    page = ElementTree.fromstring(shown._repr_html_())
    assert {element.tag for element in page.iter()} <= TAGS
    return [[cell.text for cell in row] for row in page.iter("tr")]


def tracks() -> Trajectories:
    """Two drones over 4 s: one flies 1 m/s along x; the other, at rest, comes late, coasts, is lost and comes back."""
    frame = np.arange(5)
    position_m = np.zeros((5, 2, 3), np.float32)
    position_m[:, 0, 0] = frame
    position_m[0, 1] = np.nan
    status = np.full((5, 2), Status.TRACKED)
    status[:4, 1] = [Status.LOST, Status.TRACKED, Status.COASTING, Status.LOST]
    covariance_m2 = np.tile(np.diag([1e-4, 4e-4, 7e-4]), (5, 2, 1, 1))
    known = {"status": status, "covariance_m2": covariance_m2, "num_cameras": np.full((5, 2), 6)}
    return Trajectories(frame, frame / 1.0, ("0", "<b>one</b> & co"), position_m, **known)


def test_the_summary_of_a_drone() -> None:
    columns = {
        "drone": ["0", "<b>one</b> & co"],
        # Lost before it was first seen does not count as lost.
        "seen": ["100.0%", "60.0%"],
        "coasting": ["0.0%", "20.0%"],
        "lost": ["0.0%", "20.0%"],
        "cameras": ["6.0", "6.0"],
        # The mean of the variances is 4e-4 m².
        "std (mm)": ["20.0", "20.0"],
        "from (s)": ["0.0", "1.0"],
        "to (s)": ["4.0", "4.0"],
        "extent (m)": ["4.00 0.00 0.00", "0.00 0.00 0.00"],
        "speed (m/s)": ["1.00", "0.00"],
    }
    assert summary_columns(tracks()) == columns
    assert rows_of(tracks()) == [list(columns), *map(list, zip(*columns.values(), strict=True))]
    # Unknown numbers are dashes, and unknown columns are left out.
    size_m = np.array([[0.4, 0.5, 0.1], [np.nan, 0.4, 0.1]])
    assert summary_columns(tracks(), size_m)["size (cm)"] == ["40 50 10", "-"]
    nowhere = Trajectories(np.arange(3), np.arange(3.0), ("a",), np.full((3, 1, 3), np.nan))
    assert summary_columns(nowhere) == {"drone": ["a"], "seen": ["0.0%"]}
    empty = Trajectories(np.arange(0), np.zeros(0), (), np.zeros((0, 0, 3)))
    assert summary_columns(empty) == {"drone": []}
    assert rows_of(empty) == [["drone"]]


def test_a_tracked_recording_shows_sizes_seconds_and_changed_settings() -> None:
    order, ambiguity = np.tile(np.arange(2), (5, 1)), np.zeros((5, 1))
    identities = Identities(order, np.array([[0, 1]]), ambiguity, ())
    changed = {"swarm.particles": 50, "smooth": True, "motion.max_speed_m_s": 6.0}
    record = {
        "sequence": "<u>lab</u>",
        "settings": msgspec.to_builtins(TrackSettings().changed(changed)),
        # The largest speed was not given, so nobody chose it.
        "volume": {"speed_from": "default", "bounds_from": "given"},
        "seconds": {"track": 1.25, "total": 7.0},
    }
    size_m = np.array([[0.4, 0.4, 0.1], [0.5, 0.5, 0.2]])
    rows = rows_of(TrackedRecording(tracks(), size_m, identities, record))
    sizes = rows[0].index("size (cm)")
    assert [row[sizes] for row in rows[1:3]] == ["40 40 10", "50 50 20"]
    assert ["settings", "smooth = True, swarm.particles = 50"] in rows
    assert ["seconds", "track 1.2, total 7.0"] in rows


def test_an_evaluation_and_a_recording_show_their_rows() -> None:
    rows = rows_of(evaluate(*circling_flights(names=("<i>a</i>", "b", "c"))))
    assert rows[1][:3] == ["<i>a</i> (track 0)", "20.0", "20.0"]
    assert [row[0] for row in rows[2:5]] == ["b (track 1)", "c (track 2)", "all"]
    assert {"CLEAR", "HOTA", "GOSPA", "RMSE", "centred"} <= {row[0] for row in rows}
    assert len(rows[1]) == len(rows[0])
    rig = ring_rig(3)
    cameras = cameras_of(rig, times=dict.fromkeys(rig.names, FrameTimes(10, 25.0)))
    assert [row[0] for row in rows_of(Recording("<script>lab", Path(), cameras))] == ["camera", *rig.names]

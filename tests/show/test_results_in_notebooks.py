"""What results show in a notebook: well-formed HTML with all drones, escaped names."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

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


class Page(HTMLParser):
    """Reads a page strictly: each tag is closed in order; rows of tables as lists of texts."""

    EMPTY = frozenset({"img", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.rows: list[list[str]] = []
        self.tags: set[str] = set()
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.add(tag)
        if tag in self.EMPTY:
            return
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.EMPTY:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def tracks(names: tuple[str, ...] = ("0", "<b>one</b> & co")) -> Trajectories:
    """Two drones over 4 s: one flies 1 m/s along x; the other, at rest, comes late, coasts, is lost and comes back."""
    frame = np.arange(5)
    position_m = np.zeros((5, 2, 3), np.float32)
    position_m[:, 0, 0] = frame
    position_m[0, 1] = np.nan
    status = np.full((5, 2), Status.TRACKED)
    status[:4, 1] = [Status.LOST, Status.TRACKED, Status.COASTING, Status.LOST]
    covariance_m2 = np.tile(np.diag([1e-4, 4e-4, 7e-4]), (5, 2, 1, 1))
    return Trajectories(
        frame,
        frame / 1.0,
        names,
        position_m,
        status=status,
        covariance_m2=covariance_m2,
        num_cameras=np.full((5, 2), 6),
    )


def test_the_summary_of_a_drone() -> None:
    columns = summary_columns(tracks())
    # Lost before it was first seen does not count as lost. The mean of the variances is 4e-4 m².
    assert columns == {
        "drone": list(tracks().drones),
        "seen": ["100.0%", "60.0%"],
        "coasting": ["0.0%", "20.0%"],
        "lost": ["0.0%", "20.0%"],
        "cameras": ["6.0", "6.0"],
        "std (mm)": ["20.0", "20.0"],
        "from (s)": ["0.0", "1.0"],
        "to (s)": ["4.0", "4.0"],
        "extent (m)": ["4.00 0.00 0.00", "0.00 0.00 0.00"],
        "speed (m/s)": ["1.00", "0.00"],
    }


def test_unknown_numbers_are_dashes_and_unknown_columns_are_left_out() -> None:
    nowhere = Trajectories(np.arange(3), np.arange(3.0), ("a",), np.full((3, 1, 3), np.nan))
    assert summary_columns(nowhere) == {"drone": ["a"], "seen": ["0.0%"]}
    empty = Trajectories(np.arange(0), np.zeros(0), (), np.zeros((0, 0, 3)))
    assert summary_columns(empty) == {"drone": []}
    assert Page(empty._repr_html_()).rows == [["drone"]]
    size_m = np.array([[0.4, 0.5, 0.1], [np.nan, 0.4, 0.1]])
    assert summary_columns(tracks(), size_m)["size (cm)"] == ["40 50 10", "-"]


def test_trajectories_show_a_table() -> None:
    text = tracks()._repr_html_()
    page = Page(text)
    assert page.rows[0][:3] == ["drone", "seen", "coasting"]
    assert [row[0] for row in page.rows[1:]] == ["0", "<b>one</b> & co"]
    # Names are text, not tags; viewers of saved notebooks remove style sheets and scripts.
    assert page.tags <= {"div", "b", "table", "thead", "tbody", "tr", "th", "td"}
    assert "<b>one" not in text


def test_a_tracked_recording_shows_sizes_seconds_and_changed_settings() -> None:
    order, ambiguity = np.tile(np.arange(2), (5, 1)), np.zeros((5, 1))
    changed = {"swarm.particles": 50, "smooth": True, "motion.max_speed_m_s": 6.0}
    settings = TrackSettings().changed(changed)
    tracked = TrackedRecording(
        tracks(),
        np.array([[0.4, 0.4, 0.1], [0.5, 0.5, 0.2]]),
        Identities(order, np.array([[0, 1]]), ambiguity, ()),
        {
            "sequence": "<u>lab</u>",
            "settings": msgspec.to_builtins(settings),
            # The largest speed was not given, so nobody chose it.
            "volume": {"speed_from": "default", "bounds_from": "given"},
            "seconds": {"track": 1.25, "total": 7.0},
        },
    )
    page = Page(tracked._repr_html_())
    sizes = page.rows[0].index("size (cm)")
    assert [row[sizes] for row in page.rows[1:3]] == ["40 40 10", "50 50 20"]
    assert ["settings", "smooth = True, swarm.particles = 50"] in page.rows
    assert ["seconds", "track 1.2, total 7.0"] in page.rows
    assert "u" not in page.tags


def test_an_evaluation_shows_the_numbers_of_the_terminal() -> None:
    evaluation = evaluate(*circling_flights(names=("<i>a</i>", "b", "c")))
    page = Page(evaluation._repr_html_())
    assert page.rows[1][:3] == ["<i>a</i> (track 0)", "20.0", "20.0"]
    assert [row[0] for row in page.rows[:5]] == [
        "drone",
        "<i>a</i> (track 0)",
        "b (track 1)",
        "c (track 2)",
        "all",
    ]
    assert {"CLEAR", "HOTA", "GOSPA", "RMSE", "centred"} <= {row[0] for row in page.rows}
    assert "i" not in page.tags
    assert len(page.rows[1]) == len(page.rows[0])


def test_a_recording_shows_its_cameras(tmp_path: Path) -> None:
    rig = ring_rig(3)
    times = dict.fromkeys(rig.names, FrameTimes(10, 25.0))
    recording = Recording("<script>lab", tmp_path, cameras_of(rig, times=times))
    page = Page(recording._repr_html_())
    assert [row[0] for row in page.rows] == ["camera", *rig.names]
    assert "script" not in page.tags

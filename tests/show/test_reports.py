"""Reports, 3D views and results in a notebook: what is in the pages, and, in a real browser, that they work."""

import base64
import contextlib
import html
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import msgspec
import numpy as np
import pytest
from evaluation_flights import circling_flights, on_x_axis
from helpers import cameras_of, make_once, ring_rig
from worlds import NUM_FRAMES, make_tracks

import psotrack as pt
from psotrack.evaluation import evaluate
from psotrack.pipeline import TrackedRecording
from psotrack.recordings import FrameTimes, Recording, Reference, view_in_images
from psotrack.settings import TrackSettings
from psotrack.show.flights import flight_of, read_flight
from psotrack.show.reports import MOST_BYTES, MOST_ROWS, view_3d, write_flight_report
from psotrack.show.reports.scene import scene_data
from psotrack.tracking.identity import Identities
from psotrack.trajectories import Status, Trajectories, summary_columns, write_trajectories

#: Frame in which a drone is found again.
FOUND_AGAIN = 10


@pytest.fixture(scope="session")
def reported(world, tmp_path_factory):
    """Folder with tracks.csv, whose drone 1 is lost for a while, their record, and their report.html."""

    def make(folder):
        status = np.full((NUM_FRAMES, 2), int(Status.TRACKED))
        status[6:FOUND_AGAIN, 1] = Status.LOST
        write_trajectories(
            folder / "tracks.csv", replace(make_tracks(0.01), drones=("0", "<b>1</b>"), status=status)
        )
        record = {
            "sequence": "flight",
            "drones": [{"drone": 0, "size_m": [0.5, 0.5, 0.2]}],
            "settings": {"swarm": {"particles": 77}},
            "versions": {"psotrack": "0.2"},
            "real_time_factor": 1.5,
        }
        (folder / "tracks.json").write_text(json.dumps(record), encoding="utf-8")
        pt.report(folder / "tracks.csv", folder / "report.html", recording=world / "flight")

    return make_once(tmp_path_factory, "reported", make)


@pytest.fixture
def page(reported):
    return reported / "report.html"


def text_of(path):
    return path.read_text(encoding="utf-8")


def pictures_in(page):
    """Caption and picture of each event, BGR."""
    shown = []
    found = re.findall(r'<img src="data:image/jpeg;base64,([^"]*)"[^>]* alt="([^"]*)"', text_of(page))
    for data, caption in found:
        jpeg = np.frombuffer(base64.b64decode(data), np.uint8)
        shown.append((caption, cv2.imdecode(jpeg, cv2.IMREAD_COLOR)))
    return shown


def decoded(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def test_the_page_has_all_parts_and_needs_no_other_file(page):
    text = text_of(page)
    headings = ", ".join(re.findall("<h2>(.*?)</h2>", text))
    assert headings == "Errors against the reference, Drones, Cameras, Over time, Events, How it was made"
    for words in (
        "drone &lt;b&gt;1&lt;/b&gt; is lost",
        "drone &lt;b&gt;1&lt;/b&gt; is found again",
        "&#34;swarm.particles&#34;: 77",
        "fraction of the frames in which the ellipsoid that the run states holds",
        # The tables are those of a notebook: of an evaluation, with the figures of all drones, and of tracks.
        "<td>all</td>",
        "<td>50 50 20</td>",
        "<b>1.5 times</b><span>faster than the video</span>",
    ):
        assert words in text
    assert "<b>1</b>" not in text
    assert re.findall(r"(?:src|href)=\"(?!data:|#)([^\"]*)\"", text) == []
    assert len(text) < MOST_BYTES / 4


def test_the_same_tracks_again_is_a_script_that_processes_may_import(page):
    """Processes that make silhouettes import the script again, under another name: it must not track again."""
    (script,) = re.findall(r"<pre>(import psotrack.*?)</pre>", text_of(page), re.DOTALL)
    ran = {"__name__": "__mp_main__"}
    exec(html.unescape(script), ran)
    assert "tracked" not in ran
    assert "particles" in script


def test_a_picture_shows_the_place_of_the_event(page, reported, world):
    """In the picture of the event in which a drone is found, the drone and its box are where the camera shows them."""
    ((caption, picture),) = [each for each in pictures_in(page) if "is found again" in each[0]]
    assert picture.shape == (240, 360, 3)
    flight = read_flight([reported / "tracks.csv"], world / "flight")
    tracks, camera = flight.tracks[0], int(caption[1])
    views = view_in_images(flight.recording, tracks.trajectories, tracks.size_m)
    box_px = views.boxes_px[FOUND_AGAIN, 1, camera]
    # The picture is four lengths of the largest drone high, and its middle is the drone's.
    rig = flight.recording.rig.cameras[camera]
    depth_m = (rig.T_cam_world @ [*tracks.trajectories.position_m[FOUND_AGAIN, 1], 1])[2]
    scale = 240 / (4 * 0.5 * rig.K[0, 0] / depth_m)
    middle_px = views.middle_px[FOUND_AGAIN, 1, camera] + 0.5
    left, top, right, bottom = (box_px - np.tile(middle_px, 2)) * scale + [180, 120, 180, 120]
    # The colour of drone 1, lighter; JPEG blurs colours of thin lines. The drone's name is above its box.
    rows, columns = np.nonzero(np.abs(picture.astype(int) - [51, 126, 221]).sum(axis=-1) < 90)
    below = rows > top + 3
    found = [columns[below].min(), columns[below].max() + 1, rows.max() + 1]
    # The line is two pixels wide.
    np.testing.assert_allclose(found, [left, right, bottom], atol=2.5)
    # The drone itself is a dark rectangle of 17 by 9 pixels of the camera.
    assert picture[117:126, 172:189].mean() < 60


def test_pictures_of_large_objects_show_the_whole_height(run_psotrack, reported, world, tmp_path):
    """People fill the frame: their pictures show a frame of 4:3 between two grey columns."""
    shutil.copy(reported / "tracks.csv", tmp_path / "tracks.csv")
    record = {"drones": [{"drone": 0, "size_m": [0.6, 0.6, 1.8]}]}
    (tmp_path / "tracks.json").write_text(json.dumps(record), encoding="utf-8")
    words = (tmp_path / "tracks.csv", world / "flight", "--out", tmp_path / "people.html")
    assert run_psotrack("report", *words).code == 0
    pictures = [picture for _, picture in pictures_in(tmp_path / "people.html")]
    assert pictures
    for picture in pictures:
        # The noise of the film is brighter.
        is_grey = (np.abs(picture.astype(int) - 90) < 12).all(axis=(0, 2))
        np.testing.assert_allclose(np.flatnonzero(~is_grey)[[0, -1]], [20, 339], atol=2)


def test_a_recording_without_tracks_and_a_reference_of_another_time_have_reports(flight, tmp_path):
    late = replace(flight.truth, frame=flight.truth.frame + 1000, time_s=flight.truth.time_s + 100)
    shown_late = replace(flight.recording, reference=Reference(late))
    for each in (replace(flight, tracks=()), replace(flight, recording=shown_late)):
        write_flight_report(tmp_path / "page.html", each, pictures=False, force=True)
        text = text_of(tmp_path / "page.html")
        assert "psotrackScene(document" in text
        assert "Errors against the reference" not in text


def test_without_a_recording_and_with_two_files_of_tracks(run_psotrack, reported, world, tmp_path):
    alone, two = tmp_path / "alone.html", tmp_path / "two.html"
    out = run_psotrack("report", reported / "tracks.csv", "--out", alone).out
    assert f"{pt.report(reported / 'tracks.csv', alone, force=True)}\n" == out
    assert re.fullmatch(r".*alone\.html: 0\.\d MB\n", out)
    assert "<h2>Cameras</h2>" not in text_of(alone)
    assert "<img" not in text_of(alone)
    other = shutil.copy(reported / "tracks.csv", tmp_path / "other.csv")
    words = (reported / "tracks.csv", world / "flight", "--compare", other, "--no-pictures", "--out", two)
    assert run_psotrack("report", *words).code == 0
    assert text_of(two).count("<h2>Drones</h2>") == 2
    assert "There is no record of a run beside other." in text_of(two)


# --- the 3D view


def x_shown_m(tracks):
    """Places of the first drone along x in the scene."""
    data = scene_data(flight_of(tracks))
    x_m = decoded(data["drones"][0]["position_m"])[::3]
    return x_m.astype(float) + data["origin_m"][0]


def test_positions_are_those_of_the_tracks():
    flight = flight_of(on_x_axis([0, 1, None, 3], [5, 6, 7, 8]))
    first, second = scene_data(flight)["drones"]
    np.testing.assert_array_equal(decoded(first["position_m"])[::3], [0, 1, np.nan, 3])
    np.testing.assert_array_equal(decoded(second["position_m"])[::3], [5, 6, 7, 8])
    np.testing.assert_array_equal(decoded(first["status"]), [0, 0, 2, 0])
    # A world far from its origin loses nothing; in float32, 500 km are known to 3 cm.
    tracks = on_x_axis([0, 0.001, 0.002])
    far = replace(tracks, position_m=tracks.position_m + np.array([500_000.0, 5_000_000.0, 120.0]))
    np.testing.assert_allclose(x_shown_m(far) - 500_000, [0, 0.001, 0.002], atol=1e-4)
    # Long flights show every n-th row.
    long = on_x_axis(list(range(3 * MOST_ROWS)))
    np.testing.assert_allclose(x_shown_m(long), np.arange(MOST_ROWS) * 3)


def test_pyramids_of_cameras_open_along_their_view(flight):
    cameras = flight.recording.rig.cameras
    shown = scene_data(replace(flight, tracks=()))["cameras"]
    for index, camera in enumerate(shown):
        centre_m = cameras.centre_world[index]
        np.testing.assert_allclose(camera["centre_m"], centre_m, atol=1e-12)
        rotation = np.asarray(cameras.T_cam_world[index])[:3, :3]
        seen = (camera["corners_m"] - centre_m) @ rotation.T
        depth = seen[:, 2:]
        np.testing.assert_allclose(depth, depth[:1].repeat(4, axis=0), rtol=1e-9)
        assert depth[0] > 0
        # The corners are those of the image, without its distortion.
        seen_px = seen @ np.asarray(cameras.K[index]).T / depth
        corners_px = np.array([[0, 0], [320, 0], [320, 240], [0, 240]]) - 0.5
        np.testing.assert_allclose(seen_px[:, :2], corners_px, atol=1e-9)


def test_names_cannot_leave_the_script():
    tracks = replace(on_x_axis([0, 1]), drones=("</script><script>alert(1)</script>",))
    assert "</script><script>alert" not in view_3d(tracks)._repr_html_()


# --- results in a notebook

#: Names are text, not tags; viewers of saved notebooks remove style sheets and scripts.
TAGS = {"div", "b", "table", "thead", "tbody", "tr", "th", "td"}


def rows_of(shown):
    """Texts in the rows of the tables that a result shows; each tag must be closed in order."""
    page = ElementTree.fromstring(shown._repr_html_())
    assert {element.tag for element in page.iter()} <= TAGS
    return [[cell.text for cell in row] for row in page.iter("tr")]


def tracks():
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


def test_the_summary_of_a_drone():
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
    shown = np.array(rows_of(tracks()))
    np.testing.assert_array_equal(shown[0], list(columns))
    np.testing.assert_array_equal(shown[1:].T, list(columns.values()))
    # Unknown numbers are dashes, and unknown columns are left out.
    size_m = np.array([[0.4, 0.5, 0.1], [np.nan, 0.4, 0.1]])
    assert summary_columns(tracks(), size_m)["size (cm)"] == ["40 50 10", "-"]
    nowhere = on_x_axis([None] * 3)
    assert summary_columns(nowhere) == {"drone": ["d0"], "seen": ["0.0%"]}
    empty = nowhere.of_drones([])
    assert summary_columns(empty) == {"drone": []}
    assert rows_of(empty) == [["drone"]]


def test_a_tracked_recording_shows_sizes_seconds_and_changed_settings():
    order = np.tile([0, 1], (5, 1))
    identities = Identities(order, np.array([[0, 1]]), np.zeros((5, 1)), ())
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
    assert rows[1][sizes] == "40 40 10"
    assert rows[2][sizes] == "50 50 20"
    assert ["settings", "smooth = True, swarm.particles = 50"] in rows
    assert ["seconds", "track 1.2, total 7.0"] in rows


def test_an_evaluation_and_a_recording_show_their_rows():
    est, ref = circling_flights(names=("<i>a</i>", "b", "c"))
    rows = rows_of(evaluate(est, ref))
    assert rows[1][:3] == ["<i>a</i> (track 0)", "20.0", "20.0"]
    assert [row[0] for row in rows[2:5]] == ["b (track 1)", "c (track 2)", "all"]
    assert {"CLEAR", "HOTA", "GOSPA", "RMSE", "centred"} <= {row[0] for row in rows}
    assert len(rows[1]) == len(rows[0])
    rig = ring_rig(3)
    cameras = cameras_of(rig, times=dict.fromkeys(rig.names, FrameTimes(10, 25.0)))
    rows = rows_of(Recording("<script>lab", Path(), cameras))
    assert [row[0] for row in rows] == ["camera", *rig.names]


# --- in a browser

#: Names of Chromium on the machines of Linux distributions, and of Chrome: test runs download nothing.
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
#: WebGL by software: machines that test have no graphics card. Containers run as root, without a sandbox.
SOFTWARE = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-sandbox",
]


@contextlib.contextmanager
def open_page(path, *, width=1600, scheme="light"):
    """A page of a file in Chromium, without a network; the page must not report any error.

    Without Chromium the test fails, or is skipped if PSOTRACK_NO_BROWSER is 1.
    """
    installed = [name for name in BROWSERS if shutil.which(name)]
    if not installed and os.environ.get("PSOTRACK_NO_BROWSER") == "1":
        pytest.skip("PSOTRACK_NO_BROWSER is 1")
    assert installed, (
        f"none of {', '.join(BROWSERS)} is installed; PSOTRACK_NO_BROWSER=1 leaves these tests out"
    )
    from playwright.sync_api import sync_playwright

    errors = []
    with sync_playwright() as programs:
        browser = programs.chromium.launch(executable_path=shutil.which(installed[0]), args=SOFTWARE)
        viewport = {"width": width, "height": 900}
        page = browser.new_page(viewport=viewport, color_scheme=scheme, offline=True)
        page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(f"{error}"))
        page.on("request", lambda asked: errors.append(asked.url) if asked.url.startswith("http") else None)
        page.goto(path.as_uri())
        try:
            yield page
        finally:
            browser.close()
    assert errors == []


def screenshot(locator):
    """(height, width, 3), what an element of a page shows, BGR."""
    return cv2.imdecode(np.frombuffer(locator.screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(int)


@pytest.mark.slow
def test_play_step_jump_and_sort_on_the_page_of_a_flight(page):
    """In the window of a phone, dark."""
    width = 400
    row = "document.querySelector('.scene').scene.row()"
    labels = "[...document.querySelectorAll('.scene-drone')]"
    visible = f"{labels}.filter((label) => label.style.display !== 'none').length"
    with open_page(page, width=width, scheme="dark") as shown:
        shown.wait_for_selector(".scene canvas")
        paper = shown.evaluate("getComputedStyle(document.body).backgroundColor")
        assert paper == "rgb(20, 24, 29)"
        # Nothing is wider than the window: a table that is wider scrolls by itself.
        assert shown.evaluate("document.documentElement.scrollWidth") <= width
        assert shown.evaluate(row) == 0
        before = screenshot(shown.locator(".scene-view"))
        shown.click(".scene-play")
        shown.wait_for_function(f"{row} === {NUM_FRAMES - 1}")
        assert shown.get_attribute(".scene-play", "aria-label") == "play"
        after = screenshot(shown.locator(".scene-view"))
        assert np.abs(after - before).max() > 50
        blue, green, red = after.reshape(-1, 3).T
        # Both drones' bodies are drawn in their colours, lit: the hue stays.
        assert ((blue > red + 60) & (blue > green + 20)).sum() > 20
        assert ((red > blue + 60) & (red > green + 40)).sum() > 20
        shown.focus(".scene-view")
        shown.keyboard.press("ArrowLeft")
        assert shown.evaluate(row) == NUM_FRAMES - 2
        shown.locator(".jump").first.click()
        assert shown.evaluate(row) < NUM_FRAMES - 2
        # A lost drone is not drawn.
        for instant, count in ((2, 2), (8, 1)):
            shown.evaluate(f"document.querySelector('.scene').scene.show({instant})")
            assert shown.evaluate(visible) == count
        errors = shown.locator("table:has(thead)").first
        heading = errors.locator("th button").nth(2)
        heading.click()
        shown_mm = [float(text) for text in errors.locator("tbody td:nth-child(3)").all_inner_texts()]
        assert shown_mm == sorted(shown_mm)
        heading.click()
        assert errors.locator("th").nth(2).get_attribute("aria-sort") == "descending"


@pytest.mark.nightly
def test_a_view_of_a_notebook(tmp_path):
    cell = view_3d(on_x_axis([0, 1, 2, 3]))._repr_html_()
    (tmp_path / "cell.html").write_text(f"<!doctype html><title>cell</title>{cell}", encoding="utf-8")
    with open_page(tmp_path / "cell.html") as shown:
        frame = shown.frame_locator("iframe")
        frame.locator(".scene canvas").wait_for()
        assert frame.locator(".scene-clock").inner_text() == "0.00 s"

"""Reports and 3D views: what is in the pages, and, in a real browser, that they work."""

import base64
import html
import json
import re
import shutil
from dataclasses import replace

import browser
import cv2
import numpy as np
import pytest
from evaluation_flights import on_x_axis
from helpers import assert_refused, make_once

import psotrack as pt
from psotrack.recordings import Reference
from psotrack.recordings.datasets import open_recording
from psotrack.show.flights import flight_of, read_flight
from psotrack.show.reports import MOST_BYTES, MOST_ROWS, view_3d, write_flight_report, write_page
from psotrack.show.reports.scene import scene_data
from psotrack.simulation import SimulationSettings, simulate
from psotrack.trajectories import Status, write_trajectories

FRAMES = 24


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Folder with a simulated recording `S01_D2_A`, and tracks.csv with its record: the truth with small changes."""

    def make(folder):
        settings = SimulationSettings(num_frames=FRAMES, scale=0.25, masks=False, onboard=False)
        simulate("S01_D2_A", folder, settings, jobs=1)
        truth = open_recording(folder / "Simulated_Data" / "S01_D2_A").truth
        status = np.full((FRAMES, 2), Status.TRACKED)
        status[8:12, 1] = Status.LOST
        tracks = replace(
            truth,
            drones=("0", "<b>1</b>"),
            position_m=truth.position_m + 0.02,
            orientation_wxyz=None,
            status=status,
            fitness=np.full((FRAMES, 2), 0.5),
            num_cameras=np.full((FRAMES, 2), 8),
            covariance_m2=np.broadcast_to(4e-4 * np.eye(3), (FRAMES, 2, 3, 3)).copy(),
        )
        write_trajectories(folder / "tracks.csv", tracks)
        record = {
            "sequence": "S01_D2_A",
            "drones": [{"drone": 0, "size_m": [0.5, 0.5, 0.2]}],
            "settings": {"swarm": {"particles": 77}},
            "versions": {"psotrack": "0.2"},
            "real_time_factor": 1.5,
        }
        (folder / "tracks.json").write_text(json.dumps(record), encoding="utf-8")

    return make_once(tmp_path_factory, "reported_flight", make)


@pytest.fixture(scope="module")
def sequence(flight):
    return flight / "Simulated_Data" / "S01_D2_A"


@pytest.fixture(scope="module")
def page(flight, sequence, tmp_path_factory):
    """The report of the flight."""

    def make(folder):
        pt.report(flight / "tracks.csv", folder / "report.html", recording=sequence)

    return make_once(tmp_path_factory, "report_page", make) / "report.html"


@pytest.fixture
def report(run_psotrack):
    """Runs `psotrack report`, which must succeed: what it prints."""

    def report(*words):
        done = run_psotrack("report", *words)
        assert done.code == 0, done
        return done.out

    return report


@pytest.fixture
def chromium():
    with browser.open_browser() as opened:
        yield opened


def pictures_in(page, caption=""):
    """Pictures of the events whose caption contains a text, BGR."""
    found = re.findall(r'<img src="data:image/jpeg;base64,([^"]*)"([^>]*)', page.read_text(encoding="utf-8"))
    coded = [np.frombuffer(base64.b64decode(data), np.uint8) for data, words in found if caption in words]
    return [cv2.imdecode(one, cv2.IMREAD_COLOR) for one in coded]


def decoded(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


class TestFlight:
    def test_the_page_has_all_parts_and_needs_no_other_file(self, page):
        text = page.read_text(encoding="utf-8")
        headings = (
            "Errors against the reference",
            "Drones",
            "Cameras",
            "Over time",
            "Events",
            "How it was made",
        )
        for heading in headings:
            assert f"<h2>{heading}</h2>" in text
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

    def test_the_same_tracks_again_is_a_script_that_processes_may_import(self, page):
        """Processes that make silhouettes import the script again, under another name: it must not track again."""
        (script,) = re.findall(
            r"<pre>(import psotrack.*?)</pre>", page.read_text(encoding="utf-8"), re.DOTALL
        )
        ran = {"__name__": "__mp_main__"}
        exec(html.unescape(script), ran)
        assert "tracked" not in ran
        assert "particles" in script

    @pytest.mark.parametrize("shown", ["a recording without tracks", "a reference of another time"])
    def test_what_the_viewer_shows_has_a_report(self, flight, sequence, tmp_path, shown):
        if shown == "a recording without tracks":
            read = read_flight([], sequence)
        else:
            read = read_flight([flight / "tracks.csv"], sequence)
            late = replace(read.truth, frame=read.truth.frame + 1000, time_s=read.truth.time_s + 100)
            read = replace(read, recording=replace(read.recording, reference=Reference(late)))
        write_flight_report(tmp_path / "page.html", read, pictures=False)
        text = (tmp_path / "page.html").read_text(encoding="utf-8")
        assert "psotrackScene(document" in text
        assert "Errors against the reference" not in text

    def test_pictures_show_the_place_of_the_event(self, page):
        """The box of the drone, in the drone's colour, is in the picture of the event in which the drone is found."""
        (picture,) = pictures_in(page, "is found again")
        assert picture.shape == (240, 360, 3)
        # The colour of drone 1, lighter.
        off = np.abs(picture.astype(int) - [51, 126, 221]).sum(axis=-1)
        rows, columns = np.nonzero(off < 90)
        # The whole box, with its name, a quarter as high as the picture. JPEG blurs colours of thin lines.
        assert len(rows) > 20
        assert 0 < rows.min() < rows.max() < 239
        assert 0 < columns.min() < columns.max() < 359
        assert np.ptp(columns) < 120

    def test_pictures_of_large_objects_stay_inside_the_frame(self, report, flight, sequence, tmp_path):
        """People fill the frame: their pictures show the whole height, and little grey around a frame of 4:3."""
        shutil.copy(flight / "tracks.csv", tmp_path / "tracks.csv")
        record = {"drones": [{"drone": drone, "size_m": [0.6, 0.6, 1.8]} for drone in range(2)]}
        (tmp_path / "tracks.json").write_text(json.dumps(record), encoding="utf-8")
        report(tmp_path / "tracks.csv", sequence, "--out", tmp_path / "people.html")
        pictures = pictures_in(tmp_path / "people.html")
        assert pictures
        for picture in pictures:
            grey = (np.abs(picture.astype(int) - 90) < 3).all(axis=-1)
            # Of 240 rows, the frame has all; of 360 columns, a frame of 16:9 has all too.
            assert grey.mean() < 0.02

    def test_without_a_recording_and_with_two_files_of_tracks(self, report, flight, sequence, tmp_path):
        out = report(flight / "tracks.csv", "--out", tmp_path / "alone.html")
        again = pt.report(flight / "tracks.csv", tmp_path / "alone.html", force=True)
        assert f"{again}\n" == out
        assert re.fullmatch(r".*alone\.html: 0\.\d MB\n", out)
        text = (tmp_path / "alone.html").read_text(encoding="utf-8")
        assert "<h2>Cameras</h2>" not in text
        assert "<img" not in text
        other, out = shutil.copy(flight / "tracks.csv", tmp_path / "other.csv"), tmp_path / "two.html"
        report(flight / "tracks.csv", sequence, "--compare", other, "--no-pictures", "--out", out)
        text = out.read_text(encoding="utf-8")
        assert text.count("<h2>Drones</h2>") == 2
        assert "There is no record of a run beside other." in text

    def test_pages_are_small_and_html(self, run_psotrack, flight, tmp_path):
        words = ("report", flight / "tracks.csv", "--out", tmp_path / "report.pdf")
        assert_refused(lambda: run_psotrack(*words), "ends in .html", unchanged=tmp_path)
        assert_refused(
            lambda: write_page(tmp_path / "large.html", "x" * 9_000_000),
            "expected a page of at most 8 MB, found 9.0 MB",
            unchanged=tmp_path,
        )


class TestScene:
    def test_positions_are_those_of_the_tracks(self):
        (first, second) = scene_data(flight_of(on_x_axis([0, 1, None, 3], [5, 6, 7, 8])))["drones"]
        np.testing.assert_array_equal(decoded(first["position_m"])[::3], [0, 1, np.nan, 3])
        np.testing.assert_array_equal(decoded(second["position_m"])[::3], [5, 6, 7, 8])
        np.testing.assert_array_equal(decoded(first["status"]), [0, 0, 2, 0])

    def test_a_world_far_from_its_origin_loses_nothing(self):
        """In float32, 500 km are known to 3 cm."""
        tracks = on_x_axis([0, 0.001, 0.002])
        far = replace(tracks, position_m=tracks.position_m + np.array([500_000.0, 5_000_000.0, 120.0]))
        data = scene_data(flight_of(far))
        shown = decoded(data["drones"][0]["position_m"])[::3].astype(float) + data["origin_m"][0]
        np.testing.assert_allclose(shown - 500_000, [0, 0.001, 0.002], atol=1e-4)

    def test_pyramids_of_cameras_open_along_their_view(self, sequence):
        read = read_flight([], sequence)
        rig = read.recording.rig
        for index, camera in enumerate(scene_data(read)["cameras"]):
            centre_m, corners_m = np.array(camera["centre_m"]), np.array(camera["corners_m"])
            forward = np.asarray(rig.cameras.T_cam_world[index])[2, :3]
            np.testing.assert_allclose(centre_m, rig.cameras.centre_world[index], atol=1e-12)
            depth_m = (corners_m - centre_m) @ forward
            np.testing.assert_allclose(depth_m, depth_m[0], rtol=1e-9)
            assert depth_m[0] > 0
            # The corners are those of the image, without its distortion.
            width, height = np.asarray(rig.cameras[index].image_size_wh)
            seen = (corners_m - centre_m) @ np.asarray(rig.cameras.T_cam_world[index])[:3, :3].T
            seen_px = seen @ np.asarray(rig.cameras[index].K).T / seen[:, 2:]
            np.testing.assert_allclose(seen_px[2, :2], [width - 0.5, height - 0.5])

    def test_long_flights_show_every_nth_row(self):
        data = scene_data(flight_of(on_x_axis(list(range(3 * MOST_ROWS)))))
        assert len(decoded(data["time_s"])) == MOST_ROWS

    def test_names_cannot_leave_the_script(self):
        tracks = replace(on_x_axis([0, 1]), drones=("</script><script>alert(1)</script>",))
        assert "</script><script>alert" not in view_3d(tracks)._repr_html_()


#: One page in `.ci/run`, the others by `make nightly`.
WIDTHS = [
    pytest.param(400, True, marks=pytest.mark.slow),
    pytest.param(1600, False, marks=pytest.mark.nightly),
]


class TestInABrowser:
    @pytest.mark.parametrize(("width", "dark"), WIDTHS)
    def test_the_page_of_a_flight(self, chromium, page, width, dark):
        with browser.open_page(chromium, page, width=width, dark=dark) as shown:
            shown.wait_for_selector(".scene canvas")
            paper = shown.evaluate("getComputedStyle(document.body).backgroundColor")
            assert paper == ("rgb(20, 24, 29)" if dark else "rgb(252, 252, 251)")
            # Nothing is wider than the window: a table that is wider scrolls by itself.
            assert shown.evaluate("document.documentElement.scrollWidth") <= width
            shown.evaluate("document.querySelector('.scene').scene.show(3)")
            picture = browser.screenshot(shown.locator(".scene-view")).reshape(-1, 3)
            # Both drones' bodies are drawn in their colours, lit: the hue stays.
            blue, green, red = picture.astype(int).T
            assert ((blue > red + 60) & (blue > green + 20)).sum() > 20
            assert ((red > blue + 60) & (red > green + 40)).sum() > 20

    @pytest.mark.nightly
    def test_play_step_jump_and_sort(self, chromium, page):
        with browser.open_page(chromium, page) as shown:
            shown.wait_for_selector(".scene canvas")
            row = "document.querySelector('.scene').scene.row()"
            assert shown.evaluate(row) == 0
            before = browser.screenshot(shown.locator(".scene-view"))
            shown.click(".scene-play")
            shown.wait_for_function(f"{row} > 5")
            shown.wait_for_function(f"{row} === {FRAMES - 1}")
            assert shown.get_attribute(".scene-play", "aria-label") == "play"
            assert np.abs(browser.screenshot(shown.locator(".scene-view")).astype(int) - before).max() > 50
            shown.focus(".scene-view")
            shown.keyboard.press("ArrowLeft")
            assert shown.evaluate(row) == FRAMES - 2
            shown.locator(".jump").first.click()
            assert shown.evaluate(row) < FRAMES - 2
            errors = shown.locator("table:has(thead)").first
            heading = errors.locator("th button").nth(2)
            heading.click()
            shown_mm = [float(text) for text in errors.locator("tbody td:nth-child(3)").all_inner_texts()]
            assert shown_mm == sorted(shown_mm)
            heading.click()
            assert errors.locator("th").nth(2).get_attribute("aria-sort") == "descending"

    @pytest.mark.nightly
    def test_a_lost_drone_is_not_drawn(self, chromium, page):
        with browser.open_page(chromium, page) as shown:
            shown.wait_for_selector(".scene canvas")
            labels = "[...document.querySelectorAll('.scene-drone')]"
            visible = f"{labels}.filter((label) => label.style.display !== 'none').length"
            shown.evaluate("document.querySelector('.scene').scene.show(2)")
            assert shown.evaluate(visible) == 2
            shown.evaluate("document.querySelector('.scene').scene.show(9)")
            assert shown.evaluate(visible) == 1

    @pytest.mark.nightly
    def test_a_view_of_a_notebook(self, chromium, tmp_path):
        path = tmp_path / "cell.html"
        cell = view_3d(on_x_axis([0, 1, 2, 3]))._repr_html_()
        path.write_text(f"<!doctype html><title>cell</title>{cell}", encoding="utf-8")
        with browser.open_page(chromium, path) as shown:
            cell = shown.frame_locator("iframe")
            cell.locator(".scene canvas").wait_for()
            assert cell.locator(".scene-clock").inner_text() == "0.00 s"

    @pytest.mark.nightly
    def test_without_webgl_the_rest_of_the_page_works(self, page):
        with browser.open_browser(["--disable-gpu", "--disable-3d-apis", "--no-sandbox"]) as blind:
            context = blind.new_context()
            shown = context.new_page()
            shown.goto(page.as_uri())
            shown.wait_for_selector(".scene-none")
            assert "no 3D graphics" in shown.inner_text(".scene-none")
            shown.locator(".jump").first.click()
            assert shown.locator("table:has(thead)").count() == 3

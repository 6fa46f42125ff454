"""`psotrack view`: what is in its files by Rerun's own reader, what is shown in a browser, and wrong input."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from helpers import Output, assert_refused, listening_at
from rerun.chunk import RrdReader
from worlds import (
    CAMERAS,
    COASTING,
    IMAGE_SIZE_WH,
    LOST_FROM,
    NUM_FRAMES,
    REFERENCE,
    make_sequence,
    make_tracks,
    make_tracks_file,
)

from psotrack.foreground.silhouettes import compute
from psotrack.geometry import project
from psotrack.recordings import OnboardVideo, VideoWriter, probe, read_frames, view_in_images
from psotrack.recordings.datasets import open_recording
from psotrack.show.flights import read_flight
from psotrack.show.viewer import LiveView, ViewContent, viewer_program, write_flight
from psotrack.trajectories import write_trajectories


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the sequence `flight` and the tracks `tracks.csv`, which no test changes."""
    folder = tmp_path_factory.mktemp("viewer")
    make_sequence(folder / "flight")
    make_tracks_file(folder / "tracks.csv")
    return folder


@pytest.fixture
def run(folder, monkeypatch, run_psotrack):
    """Runs `psotrack view`: exit code, stdout and stderr."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(folder / "cache"))
    return partial(run_psotrack, "view")


def read_entities(path):
    """Rerun's own reader: path of an entity -> component -> (times, values) of all rows; times are None for static."""
    found = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        times = columns.get("frame")
        for name, column in columns.items():
            if ":" not in name:
                continue
            rows = found.setdefault(str(chunk.entity_path), {}).setdefault(name, ([], []))
            rows[0].extend([None] * batch.num_rows if times is None else times.to_pylist())
            rows[1].extend(column.to_pylist())
    return found


@pytest.fixture(scope="module")
def saved(folder):
    """Entities of a file with tracks, images, silhouettes and reference."""
    flight = read_flight([folder / "tracks.csv"], folder / "flight")
    content = ViewContent(silhouettes=compute(flight.recording, cache=folder / "cache"))
    write_flight(folder / "flight.rrd", flight, content, jobs=1)
    return read_entities(folder / "flight.rrd")


def test_positions_are_those_of_the_tracks(saved):
    tracks = make_tracks(0.01)
    for drone in range(2):
        frames, centres = saved[f"/world/drones/{drone}/body"]["Boxes3D:centers"]
        assert frames == list(range(NUM_FRAMES))
        # Rerun keeps float32.
        np.testing.assert_allclose(np.array(centres)[:, 0], tracks.position_m[:, drone], atol=1e-6)
        _, halves = saved[f"/world/drones/{drone}/body"]["Boxes3D:half_sizes"]
        np.testing.assert_allclose(np.array(halves)[:, 0], [[0.15, 0.15, 0.075]] * NUM_FRAMES, atol=1e-6)
        _, axes = saved[f"/world/drones/{drone}/ellipsoid"]["Ellipsoids3D:half_sizes"]
        # 6.2514 is the 90 % quantile of chi-squared with three degrees of freedom; deviations are 2, 4 and 6 cm.
        expected = np.sqrt(6.2514) * np.array([0.02, 0.04, 0.06])
        # A lost drone has none: its ellipsoid would grow to the size of the room.
        shown = NUM_FRAMES if drone else LOST_FROM
        np.testing.assert_allclose(np.array(axes[:shown])[:, 0], [expected] * shown, rtol=1e-4)
        assert axes[shown:] == [[]] * (NUM_FRAMES - shown)
    truth = np.array(saved["/world/truth/dron1/point"]["Points3D:positions"][1])[:, 0]
    np.testing.assert_allclose(truth, make_tracks().position_m[:, 0], atol=1e-6)


def test_in_a_gap_a_drone_is_not_shown(tmp_path):
    tracks = make_tracks()
    position_m = tracks.position_m.copy()
    position_m[[3, 4], 0] = np.nan
    write_trajectories(tmp_path / "gaps.csv", replace(tracks, position_m=position_m, velocity_m_s=None))
    write_flight(tmp_path / "gaps.rrd", read_flight([tmp_path / "gaps.csv"]))
    entities = read_entities(tmp_path / "gaps.rrd")
    for path, component in (("body", "Boxes3D:centers"), ("trail", "LineStrips3D:strips")):
        frames, values = entities[f"/world/drones/0/{path}"][component]
        shown = dict(zip(frames, values, strict=True))
        assert shown[3] == shown[4] == []
        assert len(shown[6]) == 1


def test_status_is_shown_by_words_and_colours(saved):
    labels = [row[0] for row in saved["/world/drones/1/body"]["Boxes3D:labels"][1]]
    assert labels[COASTING] == ["1 coasting"] * 2
    assert set(labels[: COASTING.start] + labels[COASTING.stop :]) == {"1"}
    colours = np.array(saved["/world/drones/1/body"]["Boxes3D:colors"][1])[:, 0]
    assert len(set(colours[COASTING])) == 1
    assert set(colours[COASTING]).isdisjoint(colours[: COASTING.start])
    assert len(set(np.array(saved["/world/drones/0/body"]["Boxes3D:colors"][1])[:, 0])) == 2
    frames, words = saved["/status/1"]["StateChange:state"]
    assert list(zip(frames, [word[0] for word in words], strict=True)) == [
        (0, "tracked"),
        (COASTING.start, "coasting"),
        (COASTING.stop, "tracked"),
    ]
    frames, texts = saved["/events/lost"]["TextLog:text"]
    assert frames == [LOST_FROM]
    assert texts == [["drone 0 is lost"]]


def test_plots_have_the_values_of_the_tracks(saved):
    score = np.array(saved["/plots/score/0"]["Scalars:scalars"][1])[:, 0]
    np.testing.assert_allclose(score[:LOST_FROM], 0.6)
    assert np.isnan(score[LOST_FROM:]).all()
    deviation_mm = np.array(saved["/plots/deviation_mm/1"]["Scalars:scalars"][1])
    np.testing.assert_allclose(deviation_mm, 1e3 * np.sqrt(0.0056), rtol=1e-6)
    errors_mm = np.array(saved["/plots/error_mm/dron2"]["Scalars:scalars"][1])
    np.testing.assert_allclose(errors_mm, 10.0, rtol=1e-6)


def test_images_decode_and_are_those_of_the_videos(saved, folder):
    recording = open_recording(folder / "flight")
    for name in CAMERAS:
        frames, blobs = saved[f"/world/cameras/{name}/image"]["EncodedImage:blob"]
        assert frames == list(range(NUM_FRAMES))
        images = [
            cv2.imdecode(np.frombuffer(bytes(blob[0]), np.uint8), cv2.IMREAD_UNCHANGED) for blob in blobs
        ]
        for image, frame in zip(images, read_frames(recording.videos[name]), strict=True):
            assert image.shape == frame.shape
            # Noise of 30 levels loses some of them in JPEG; another frame differs by 12 on average.
            assert np.abs(image.astype(float) - frame).mean() < 6
        blobs = saved[f"/world/cameras/{name}/silhouettes"]["EncodedImage:blob"][1]
        mask = cv2.imdecode(np.frombuffer(bytes(blobs[0][0]), np.uint8), cv2.IMREAD_UNCHANGED)
        assert mask.shape[2] == 4, "silhouettes are transparent where nothing is"


def test_boxes_and_ellipses_are_about_the_drones(saved, folder):
    flight = read_flight([folder / "tracks.csv"], folder / "flight")
    tracks = flight.tracks[0]
    expected = view_in_images(flight.recording, tracks.trajectories, tracks.size_m).boxes_px
    for index, name in enumerate(CAMERAS):
        centres = saved[f"/world/cameras/{name}/boxes"]["Boxes2D:centers"][1]
        halves = saved[f"/world/cameras/{name}/boxes"]["Boxes2D:half_sizes"][1]
        labels = saved[f"/world/cameras/{name}/boxes"]["Boxes2D:labels"][1]
        outlines = saved[f"/world/cameras/{name}/ellipses"]["LineStrips2D:strips"][1]
        pixels, _ = project(flight.recording.rig.cameras[index], tracks.trajectories.position_m)
        for frame in range(NUM_FRAMES):
            seen = [1] if frame >= LOST_FROM else [0, 1]
            assert labels[frame] == [str(drone) for drone in seen]
            xyxy = np.hstack(
                [np.subtract(centres[frame], halves[frame]), np.add(centres[frame], halves[frame])]
            )
            np.testing.assert_allclose(xyxy, expected[frame, seen, index], atol=1e-3)
            for drone, outline in zip(seen, outlines[frame], strict=True):
                # The outline is symmetric about the drone's pixel, which has its centre half a pixel further in Rerun.
                middle = np.mean(outline[:-1], axis=0)
                np.testing.assert_allclose(middle, pixels[frame, drone] + 0.5, atol=1e-2)


def test_cameras_stand_where_the_rig_says(saved, folder):
    rig = open_recording(folder / "flight").rig
    for index, name in enumerate(CAMERAS):
        components = saved[f"/world/cameras/{name}"]
        times, places = components["Transform3D:translation"]
        assert times == [None]
        np.testing.assert_allclose(places[0][0], rig.cameras[index].centre_world, atol=1e-5)
        K = np.reshape(components["Pinhole:image_from_camera"][1][0][0], (3, 3)).T
        np.testing.assert_allclose(K[:2, 2], rig.cameras[index].K[:2, 2] + 0.5, atol=1e-4)
        np.testing.assert_array_equal(components["Pinhole:resolution"][1][0][0], IMAGE_SIZE_WH)


def test_two_files_of_tracks_are_two_colours(run, folder, tmp_path):
    other, out = make_tracks_file(tmp_path / "other.csv", 0.05), tmp_path / "both.rrd"
    assert run(folder / "tracks.csv", other, "--save", out, "--quiet").code == 0
    entities = read_entities(out)
    colours = {
        (name, drone): entities[f"/world/drones/{name}/{drone}/body"]["Boxes3D:colors"][1][0][0]
        for name in ("tracks", "other")
        for drone in range(2)
    }
    assert colours["tracks", 0] == colours["tracks", 1]
    assert colours["other", 0] == colours["other", 1]
    assert colours["tracks", 0] != colours["other", 0]
    assert not any(path.startswith("/world/cameras") for path in entities), "no recording is given"


def test_what_a_file_has_is_said(run, folder, tmp_path):
    arguments = (folder / "tracks.csv", folder / "flight", "--save", tmp_path / "x.rrd")
    code, out, _ = run(*arguments, "--cache", tmp_path / "empty")
    assert code == 0
    assert f"{len(CAMERAS) * NUM_FRAMES} images (every frame, full size)" in out
    assert "--silhouettes computes them" in out
    assert not (tmp_path / "empty").exists()


@pytest.mark.parametrize("share", [0.8, 0.25])
def test_files_are_not_larger_than_demanded(folder, tmp_path, share):
    flight = read_flight([folder / "tracks.csv"], folder / "flight")
    full = write_flight(tmp_path / "full.rrd", flight, jobs=1)
    bare = write_flight(tmp_path / "bare.rrd", replace(flight, recording=None), jobs=1)
    max_bytes = bare.num_bytes + share * (full.num_bytes - bare.num_bytes)
    small = write_flight(tmp_path / "small.rrd", flight, ViewContent(max_bytes=max_bytes), jobs=1)
    # What a file needs beside its images, 250 kB, is a large part of this small flight's size.
    assert 0.5 * max_bytes < small.num_bytes <= max_bytes
    assert small.num_bytes == (tmp_path / "small.rrd").stat().st_size
    images = read_entities(tmp_path / "small.rrd")["/world/cameras/c1/image"]["EncodedImage:blob"]
    assert images[0] == list(range(0, NUM_FRAMES, small.plan.step))


def test_the_first_frames_only(run, folder, tmp_path):
    arguments = (folder / "tracks.csv", folder / "flight", "--frames", 5, "--cameras", "c0,c2")
    assert run(*arguments, "--save", tmp_path / "part.rrd")[0] == 0
    entities = read_entities(tmp_path / "part.rrd")
    assert entities["/world/cameras/c0/image"]["EncodedImage:blob"][0] == list(range(5))
    assert entities["/world/drones/1/body"]["Boxes3D:centers"][0] == list(range(5))
    assert entities["/world/truth/dron1/point"]["Points3D:positions"][0] == list(range(5))
    assert "/world/cameras/c1" not in entities


def test_a_recording_without_tracks_and_tracks_without_status(run, folder, tmp_path):
    """Tracks of other programs have positions alone."""
    assert run(folder / "flight", "--save", tmp_path / "only.rrd").code == 0
    entities = read_entities(tmp_path / "only.rrd")
    assert {f"/world/truth/{name}/point" for name in REFERENCE} <= set(entities)
    assert not any("drones" in path for path in entities)
    path = tmp_path / "other.csv"
    plain = replace(
        make_tracks(), velocity_m_s=None, fitness=None, num_cameras=None, status=None, covariance_m2=None
    )
    write_trajectories(path, plain)
    assert run(path, "--save", tmp_path / "other.rrd").code == 0
    entities = read_entities(tmp_path / "other.rrd")
    assert len(entities["/world/drones/0/body"]["Boxes3D:centers"][0]) == NUM_FRAMES
    assert not any("ellipsoid" in path for path in entities)


#: Options of `psotrack view` -> words of the line.
BAD = {
    "--save x.rrd": ["Missing argument 'TRACKS... [SEQ]'"],
    "{tracks} --save x.html": ["ends in .rrd"],
    "{tracks} --save x.rrd --web": ["both"],
    "{tracks} {flight} --save x.rrd --onboard": ["--onboard"],
    "{tracks}": ["--save", "--web", "a screen"],
}


@pytest.mark.parametrize("words", BAD)
def test_wrong_input_is_one_line(run, folder, tmp_path, monkeypatch, words):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.chdir(tmp_path)
    given = words.format(tracks=folder / "tracks.csv", flight=folder / "flight").split()
    assert_refused(lambda: run(*given), *BAD[words], unchanged=tmp_path)


def test_a_window_that_cannot_open_is_one_line(run, folder, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":987")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    code, _, err = run(folder / "tracks.csv")
    assert (code, err.count("\n")) == (2, 1), err
    assert "--save" in err


HIDDEN = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("rerun", "rerun_cli", "rerun_bindings"):
            raise ModuleNotFoundError(f"No module named {name!r}")
sys.meta_path.insert(0, Hidden())
"""
LIMITED = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "words"),
    [(HIDDEN, ["pip install '.[view]'"]), (LIMITED, ["x.rrd", "the whole file", "disk"])],
    ids=["without Rerun", "on a full disk"],
)
def test_what_the_machine_lacks_is_one_line(folder, tmp_path, code, words):
    def view():
        program = f"{code}\nfrom psotrack.__main__ import main\nmain()"
        command = [sys.executable, "-c", program, "view", folder / "tracks.csv", "--save", tmp_path / "x.rrd"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        return Output(done.returncode, done.stdout, done.stderr)

    assert_refused(view, *words, unchanged=tmp_path)


#: The program with Ctrl-C as at a terminal: a shell starts programs in the background with Ctrl-C ignored.
HEARS_CTRL_C = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from psotrack.__main__ import main
main()
"""


@pytest.mark.slow
def test_the_page_for_a_browser(start_python, folder):
    """The page is served to this computer only, and Ctrl-C ends the command and its server."""
    process = start_python("-c", HEARS_CTRL_C, "view", folder / "tracks.csv", "--web")
    page = next(line.split()[0] for line in process.stdout if line.startswith("http://"))
    assert page.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(page, timeout=60) as answer:
        assert b"<html" in answer.read().lower()
    assert listening_at(process.pid) == {"127.0.0.1"}
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(page, timeout=60)


def test_cameras_on_drones_have_paths_and_markers(folder, tmp_path):
    white = np.full((240, 320, 3), 255, np.uint8)
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 96)
    white[72:168, 100:196] = marker[..., None]
    with VideoWriter(tmp_path / "dron1.avi", 25.0, (320, 240)) as writer:
        for _ in range(5):
            writer.write(white)
    turned = np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (5, 1))  # a quarter about z
    position_m = np.arange(15.0).reshape(5, 3)
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    flight = read_flight([folder / "tracks.csv"], folder / "flight")
    onboard = {"dron1": OnboardVideo(probe(tmp_path / "dron1.avi"), K, position_m, turned)}
    flight = replace(flight, recording=replace(flight.recording, onboard=onboard))
    write_flight(tmp_path / "x.rrd", flight, ViewContent(onboard=True, dictionary="4x4_50"), jobs=1)
    entities = read_entities(tmp_path / "x.rrd")
    places = np.array(entities["/world/onboard/dron1"]["Transform3D:translation"][1])[:, 0]
    np.testing.assert_allclose(places, position_m)
    # Rerun keeps matrices column by column: the first column is where the camera's x axis points, y.
    columns = np.array(entities["/world/onboard/dron1"]["Transform3D:mat3x3"][1])[:, 0]
    np.testing.assert_allclose(columns[:, :3], [[0.0, 1.0, 0.0]] * 5, atol=1e-6)
    assert len(entities["/world/onboard/dron1/image"]["EncodedImage:blob"][0]) == 5
    markers = entities["/world/onboard/dron1/markers"]
    assert markers["LineStrips2D:labels"][1] == [["7"]] * 5
    for strips in markers["LineStrips2D:strips"][1]:
        # Edges of the marker as pixels are counted from their corners; the codec blurs them by less than half a pixel.
        np.testing.assert_allclose(strips[0][0], [100, 72], atol=0.5)
        np.testing.assert_allclose(strips[0][2], [196, 168], atol=0.5)


@pytest.mark.slow
# The program that keeps the rows is stopped while it waits for more.
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_rows_of_a_live_session_arrive_in_the_viewer(folder, tmp_path):
    """Another program of Rerun connects to the viewer's address and keeps what it gets."""
    recording = open_recording(folder / "flight")
    tracks, saved = make_tracks(), tmp_path / "live.rrd"
    with LiveView(recording, web=True) as view:
        assert view.page.startswith("http://127.0.0.1:")
        for frame in range(NUM_FRAMES):
            view.write(tracks.at_frames(np.array([frame])))
            view.show_delay(0.02)
        last = tracks.at_frames(np.array([NUM_FRAMES - 1]))
        view.write(
            replace(
                last, frame=last.frame + 1, time_s=last.time_s + 0.04, position_m=last.position_m * np.nan
            )
        )
        address = re.findall(r"%3A(\d+)%2Fproxy", view.page)[0]
        program = (sys.executable, "-m", "rerun_cli", "--connect", f"rerun+http://127.0.0.1:{address}/proxy")
        keeper = subprocess.Popen(
            [*program, "--save", str(saved), "--bind", "127.0.0.1", "--port", "auto"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        # The program gets all rows that there are; its file grows until then.
        sizes = [-2, -1]
        while sizes[-1] != sizes[-2] or sizes[-1] <= 0:
            time.sleep(1)
            sizes.append(saved.stat().st_size if saved.exists() else 0)
        os.killpg(keeper.pid, signal.SIGTERM)
        keeper.wait(20)
    entities = read_entities(saved)
    # The drones are one entity, which the viewer gets in a tenth of the time of one entity per drone.
    body = entities["/world/drones/body"]
    np.testing.assert_allclose(body["Boxes3D:centers"][1][:-1], tracks.position_m, atol=1e-6)
    assert body["Boxes3D:centers"][1][-1] == [], "drones without a place are not shown"
    words = [word[0] for word in entities["/status/1"]["StateChange:state"][1]]
    assert words == ["tracked", "coasting", "tracked"]
    # Lines have the colours of the drones, and a lost drone has neither a line nor an ellipsoid.
    line, deviation = entities["/plots/deviation_mm"], 1e3 * np.sqrt(0.0056)
    assert line["SeriesLines:colors"][1][0] == body["Boxes3D:colors"][1][0]
    assert line["SeriesLines:names"][1][0] == ["0", "1"]
    expected_mm = np.where(np.arange(NUM_FRAMES + 1)[:, None] < [LOST_FROM, NUM_FRAMES], deviation, np.nan)
    np.testing.assert_allclose(line["Scalars:scalars"][1], expected_mm, rtol=1e-6)
    ellipsoids = entities["/world/drones/ellipsoid"]["Ellipsoids3D:half_sizes"][1]
    assert [len(each) for each in ellipsoids] == [2] * LOST_FROM + [1] * (NUM_FRAMES - LOST_FROM) + [0]
    # A trail begins with the drone and gets longer.
    trails = entities["/world/drones/trail"]["LineStrips3D:strips"][1]
    np.testing.assert_allclose(trails[-2], tracks.position_m.swapaxes(0, 1), atol=1e-6)
    assert entities["/plots/delay_ms"]["Scalars:scalars"][1] == [[20.0]] * NUM_FRAMES
    assert "/world/cameras/c0" in entities


def test_no_other_program_takes_the_port_of_the_viewer(monkeypatch):
    """A port that was free when it was looked for may be taken when the viewer starts."""
    taken, start = [], subprocess.Popen

    def start_late(command, **options):
        for port in (int(word) for word in command if word.isdigit() and int(word)):
            taken.append(socket.create_server(("127.0.0.1", port)))
        return start(command, **options)

    monkeypatch.setattr(subprocess, "Popen", start_late)
    with contextlib.ExitStack() as ends:
        program = ends.enter_context(viewer_program(web=True))
        for server in taken:
            ends.enter_context(server)
        with urllib.request.urlopen(program.page, timeout=10) as answer:
            assert b"<html" in answer.read().lower()

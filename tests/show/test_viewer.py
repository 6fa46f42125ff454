"""`psotrack view`: what is in its files by Rerun's own reader, in a browser and live, and what the machine lacks."""

import os
import re
import signal
import sys
import urllib.request
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import rerun as rr
from helpers import AT_A_TERMINAL, Output, assert_refused, drawn_silhouettes, listening_at
from rerun.chunk import RrdReader
from worlds import CAMERAS, COASTING, IMAGE_SIZE_WH, LOST_FROM, NUM_FRAMES, REFERENCE, make_tracks

from psotrack.geometry import project
from psotrack.geometry.rig_files import read_rig
from psotrack.recordings import OnboardVideo, VideoWriter, probe, read_frames, view_in_images
from psotrack.show.flights import read_flight
from psotrack.show.viewer import LiveView, ViewContent, write_flight
from psotrack.trajectories import write_trajectories


@pytest.fixture
def run(run_psotrack, monkeypatch, tmp_path):
    """Runs `psotrack view`."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(tmp_path / "cache"))
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
def silhouettes(world):
    """The silhouettes of the drones, by rays through each pixel."""
    size_m = np.tile([0.3, 0.3, 0.15], (2, 1))
    rig = read_rig(world / "flight" / "rig.toml")
    return drawn_silhouettes(rig, make_tracks().position_m, size_m, 2)


@pytest.fixture(scope="module")
def saved(world, silhouettes, tmp_path_factory):
    """Entities of a file with tracks, images, silhouettes and reference."""
    path = tmp_path_factory.mktemp("viewer") / "flight.rrd"
    flight = read_flight([world / "tracks.csv"], world / "flight")
    write_flight(path, flight, ViewContent(silhouettes=silhouettes), jobs=1)
    return read_entities(path)


def test_positions_are_those_of_the_tracks(saved):
    tracks = make_tracks(0.01)
    for drone in range(2):
        body = saved[f"/world/drones/{drone}/body"]
        frames, centres = body["Boxes3D:centers"]
        assert frames == list(range(NUM_FRAMES))
        # Rerun keeps float32.
        np.testing.assert_allclose(np.array(centres)[:, 0], tracks.position_m[:, drone], atol=1e-6)
        _, halves = body["Boxes3D:half_sizes"]
        np.testing.assert_allclose(halves, [[[0.15, 0.15, 0.075]]] * NUM_FRAMES, atol=1e-6)
        _, axes = saved[f"/world/drones/{drone}/ellipsoid"]["Ellipsoids3D:half_sizes"]
        # 6.2514 is the 90 % quantile of chi-squared with three degrees of freedom; deviations are 2, 4 and 6 cm.
        expected = np.sqrt(6.2514) * np.array([0.02, 0.04, 0.06])
        # A lost drone has none: its ellipsoid would grow to the size of the room.
        shown = NUM_FRAMES if drone else LOST_FROM
        np.testing.assert_allclose(np.array(axes[:shown])[:, 0], [expected] * shown, rtol=1e-4)
        assert axes[shown:] == [[]] * (NUM_FRAMES - shown)
    truth = np.array(saved["/world/truth/dron1/point"]["Points3D:positions"][1])[:, 0]
    np.testing.assert_allclose(truth, make_tracks().position_m[:, 0], atol=1e-6)


def test_status_is_shown_by_words_and_colours(saved):
    body = saved["/world/drones/1/body"]
    labels = [row[0] for row in body["Boxes3D:labels"][1]]
    assert labels[COASTING] == ["1 coasting"] * 2
    assert labels[: COASTING.start] == ["1"] * COASTING.start
    assert set(labels[COASTING.stop :]) == {"1"}
    colours = np.array(body["Boxes3D:colors"][1])[:, 0]
    before, during = set(colours[: COASTING.start]), set(colours[COASTING])
    assert len(during) == 1
    assert during.isdisjoint(before)
    frames, words = saved["/status/1"]["StateChange:state"]
    assert frames == [0, COASTING.start, COASTING.stop]
    assert words == [["tracked"], ["coasting"], ["tracked"]]
    assert saved["/events/lost"]["TextLog:text"] == ([LOST_FROM], [["drone 0 is lost"]])


def test_plots_have_the_values_of_the_tracks(saved):
    score = np.array(saved["/plots/score/0"]["Scalars:scalars"][1])[:, 0]
    np.testing.assert_allclose(score[:LOST_FROM], 0.6)
    assert np.isnan(score[LOST_FROM:]).all()
    deviation_mm = np.array(saved["/plots/deviation_mm/1"]["Scalars:scalars"][1])
    np.testing.assert_allclose(deviation_mm, 1e3 * np.sqrt(0.0056), rtol=1e-6)
    errors_mm = np.array(saved["/plots/error_mm/dron2"]["Scalars:scalars"][1])
    np.testing.assert_allclose(errors_mm, 10.0, rtol=1e-6)


def decoded(blob):
    return cv2.imdecode(np.frombuffer(bytes(blob[0]), np.uint8), cv2.IMREAD_UNCHANGED)


def test_images_and_silhouettes_are_those_of_the_cameras(saved, flight, silhouettes):
    for name, coverage in zip(CAMERAS, silhouettes.arrays, strict=True):
        camera = f"/world/cameras/{name}"
        frames, images = saved[f"{camera}/image"]["EncodedImage:blob"]
        _, masks = saved[f"{camera}/silhouettes"]["EncodedImage:blob"]
        _, centres = saved[f"{camera}/blobs"]["Boxes2D:centers"]
        _, halves = saved[f"{camera}/blobs"]["Boxes2D:half_sizes"]
        assert frames == list(range(NUM_FRAMES))
        filmed = read_frames(flight.recording.videos[name])
        for frame, before in enumerate(filmed):
            # Noise of 30 levels loses some of them in JPEG; another frame differs by 12 on average.
            image = decoded(images[frame])
            assert np.abs(image.astype(float) - before).mean() < 6
            # As opaque as a cell is covered, up to 55 %, and without colour where nothing is.
            mask = decoded(masks[frame])
            covered = coverage[frame]
            np.testing.assert_allclose(mask[..., 3], 0.55 * covered, atol=1)
            assert (mask[covered == 0] == 0).all()
            assert (mask[covered > 0][:, :3] == [0, 255, 170]).all()
            # Boxes of blobs hold the covered cells, of two pixels.
            cells = np.argwhere(covered > 128)[:, None, ::-1]
            off_px = np.abs(2 * cells + 1 - centres[frame]) - halves[frame]
            nearest_px = off_px.max(axis=2).min(axis=1)
            assert (nearest_px < 2).all()


def test_boxes_and_ellipses_are_about_the_drones(saved, flight):
    rig, tracks = flight.recording.rig, flight.tracks[0]
    expected = view_in_images(flight.recording, tracks.trajectories, tracks.size_m).boxes_px
    for index, name in enumerate(CAMERAS):
        boxes = saved[f"/world/cameras/{name}/boxes"]
        _, labels = boxes["Boxes2D:labels"]
        _, centres = boxes["Boxes2D:centers"]
        _, halves = boxes["Boxes2D:half_sizes"]
        _, outlines = saved[f"/world/cameras/{name}/ellipses"]["LineStrips2D:strips"]
        pixels, _ = project(rig.cameras[index], tracks.trajectories.position_m)
        for frame in range(NUM_FRAMES):
            seen = [0, 1] if frame < LOST_FROM else [1]
            assert labels[frame] == [str(drone) for drone in seen]
            low = np.subtract(centres[frame], halves[frame])
            high = np.add(centres[frame], halves[frame])
            np.testing.assert_allclose(np.hstack([low, high]), expected[frame, seen, index], atol=1e-3)
            # The outline is symmetric about the drone's pixel, which has its centre half a pixel further in Rerun.
            for outline, pixel in zip(outlines[frame], pixels[frame, seen], strict=True):
                middle = np.mean(outline[:24], axis=0)
                np.testing.assert_allclose(middle, pixel + 0.5, atol=1e-2)


def test_cameras_stand_where_the_rig_says(saved, flight):
    cameras = flight.recording.rig.cameras
    for index, name in enumerate(CAMERAS):
        camera = saved[f"/world/cameras/{name}"]
        times, places = camera["Transform3D:translation"]
        assert times == [None]
        np.testing.assert_allclose(places[0][0], cameras.centre_world[index], atol=1e-5)
        _, projections = camera["Pinhole:image_from_camera"]
        K = np.reshape(projections[0][0], (3, 3)).T
        np.testing.assert_allclose(K[:2, 2], cameras.K[index, :2, 2] + 0.5, atol=1e-4)
        _, sizes = camera["Pinhole:resolution"]
        np.testing.assert_array_equal(sizes[0][0], IMAGE_SIZE_WH)


def test_the_first_frames_of_some_cameras_and_what_the_file_has_is_said(run, world, tmp_path):
    arguments = (world / "tracks.csv", world / "flight", "--frames", 5, "--cameras", "c0,c2")
    _, out, _ = run(*arguments, "--save", tmp_path / "part.rrd").ended()
    assert "10 images (every frame, full size)" in out
    assert "--silhouettes computes them" in out
    assert not (tmp_path / "cache").exists()
    entities = read_entities(tmp_path / "part.rrd")
    images, _ = entities["/world/cameras/c0/image"]["EncodedImage:blob"]
    bodies, _ = entities["/world/drones/1/body"]["Boxes3D:centers"]
    assert images == bodies == [0, 1, 2, 3, 4]
    assert "/world/cameras/c1" not in entities


def test_files_are_not_larger_than_demanded(flight, tmp_path):
    full = write_flight(tmp_path / "full.rrd", flight, jobs=1)
    bare = write_flight(tmp_path / "bare.rrd", replace(flight, recording=None), jobs=1)
    max_bytes = bare.num_bytes + 0.25 * (full.num_bytes - bare.num_bytes)
    small = write_flight(tmp_path / "small.rrd", flight, ViewContent(max_bytes=max_bytes), jobs=1)
    # What a file needs beside its images, 250 kB, is a large part of this small flight's size.
    assert 0.5 * max_bytes < small.num_bytes <= max_bytes
    assert small.num_bytes == (tmp_path / "small.rrd").stat().st_size
    images = read_entities(tmp_path / "small.rrd")["/world/cameras/c1/image"]["EncodedImage:blob"]
    assert images[0] == list(range(0, NUM_FRAMES, small.plan.step))


def test_a_recording_without_tracks_and_tracks_with_positions_alone(run, world, tmp_path):
    """Tracks of other programs have neither status nor covariances; in a gap, a drone is not shown."""
    assert run(world / "flight", "--save", tmp_path / "only.rrd").code == 0
    entities = read_entities(tmp_path / "only.rrd")
    assert {f"/world/truth/{name}/point" for name in REFERENCE} <= set(entities)
    assert not any("drones" in path for path in entities)
    tracks = make_tracks()
    tracks.position_m[3:5, 0] = np.nan
    unknown = dict.fromkeys(("velocity_m_s", "fitness", "num_cameras", "status", "covariance_m2"))
    write_trajectories(tmp_path / "other.csv", replace(tracks, **unknown))
    assert run(tmp_path / "other.csv", "--save", tmp_path / "other.rrd").code == 0
    entities = read_entities(tmp_path / "other.rrd")
    assert not any("ellipsoid" in path for path in entities)
    assert len(entities["/world/drones/1/body"]["Boxes3D:centers"][0]) == NUM_FRAMES
    _, centres = entities["/world/drones/0/body"]["Boxes3D:centers"]
    _, trails = entities["/world/drones/0/trail"]["LineStrips3D:strips"]
    for shown in (centres, trails):
        assert shown[3] == shown[4] == []
        assert len(shown[6]) == 1


def test_what_the_machine_lacks_is_one_line(run, world, tmp_path, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":987")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    # Rerun's window cannot open.
    assert_refused(lambda: run(world / "tracks.csv", "--quiet"), "--save", unchanged=tmp_path)
    monkeypatch.setitem(sys.modules, "rerun_cli", None)
    words = (world / "tracks.csv", "--save", tmp_path / "x.rrd")
    assert_refused(lambda: run(*words), "pip install '.[view]'", unchanged=tmp_path)


#: The program on a disk that is full soon. It is a process of its own: Rerun may wait without end for such a disk.
ON_A_FULL_DISK = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
from psotrack.__main__ import main
main()
"""


@pytest.mark.slow
def test_a_full_disk_is_one_line(start_python, world, tmp_path):
    def view():
        words = ("view", world / "tracks.csv", "--save", tmp_path / "x.rrd")
        process = start_python("-c", ON_A_FULL_DISK, *words)
        out, err = process.communicate(timeout=60)
        return Output(process.returncode, out, err)

    assert_refused(view, "x.rrd", "the whole file", "disk", unchanged=tmp_path)


@pytest.mark.slow
def test_the_page_for_a_browser(start_python, world):
    """The page is served to this computer only, and Ctrl-C ends the command and its server."""
    process = start_python("-c", AT_A_TERMINAL, "view", world / "tracks.csv", "--web")
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


def test_cameras_on_drones_have_paths_and_markers(flight, tmp_path):
    white = np.full((240, 320, 3), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    marker = cv2.aruco.generateImageMarker(dictionary, 7, 96)
    white[72:168, 100:196] = marker[..., None]
    with VideoWriter(tmp_path / "dron1.avi", 25.0, (320, 240)) as writer:
        for _ in range(5):
            writer.write(white)
    turned = np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (5, 1))  # a quarter about z
    position_m = np.arange(15.0).reshape(5, 3)
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    onboard = {"dron1": OnboardVideo(probe(tmp_path / "dron1.avi"), K, position_m, turned)}
    flight = replace(flight, recording=replace(flight.recording, onboard=onboard))
    write_flight(tmp_path / "x.rrd", flight, ViewContent(onboard=True, dictionary="4x4_50"), jobs=1)
    entities = read_entities(tmp_path / "x.rrd")
    camera = entities["/world/onboard/dron1"]
    _, places = camera["Transform3D:translation"]
    np.testing.assert_allclose(np.array(places)[:, 0], position_m)
    # Rerun keeps matrices column by column: the first column is where the camera's x axis points, y.
    _, matrices = camera["Transform3D:mat3x3"]
    np.testing.assert_allclose(np.array(matrices)[:, 0, :3], [[0.0, 1.0, 0.0]] * 5, atol=1e-6)
    frames, _ = entities["/world/onboard/dron1/image"]["EncodedImage:blob"]
    assert len(frames) == 5
    markers = entities["/world/onboard/dron1/markers"]
    assert markers["LineStrips2D:labels"][1] == [["7"]] * 5
    for (outline,) in markers["LineStrips2D:strips"][1]:
        # Edges of the marker as pixels are counted from their corners; the codec blurs them by less than half a pixel.
        np.testing.assert_allclose(outline[0], [100, 72], atol=0.5)
        np.testing.assert_allclose(outline[2], [196, 168], atol=0.5)


def test_rows_of_a_live_session_go_to_the_viewer(flight, tmp_path, monkeypatch):
    """What is sent to the viewer's address goes to a file as well."""
    addresses, saved, tracks = [], tmp_path / "live.rrd", make_tracks()

    def connect(stream, address):
        addresses.append(address)
        stream.set_sinks(rr.GrpcSink(address), rr.FileSink(saved))

    monkeypatch.setattr(rr.RecordingStream, "connect_grpc", connect)
    with LiveView(flight.recording, web=True) as view:
        assert listening_at(os.getpid()) == {"127.0.0.1"}
        for frame in range(NUM_FRAMES):
            row = tracks.at_frames(np.array([frame]))
            view.write(row)
            view.show_delay(0.02)
        nowhere_m = row.position_m * np.nan
        gone = replace(row, frame=row.frame + 1, time_s=row.time_s + 0.04, position_m=nowhere_m)
        view.write(gone)
    (port,) = re.findall(r"^http://127\.0\.0\.1:.*%3A(\d+)%2Fproxy", view.page)
    assert addresses == [f"rerun+http://127.0.0.1:{port}/proxy"]
    entities = read_entities(saved)
    # The drones are one entity, which the viewer gets in a tenth of the time of one entity per drone.
    body = entities["/world/drones/body"]
    *centres, last = body["Boxes3D:centers"][1]
    np.testing.assert_allclose(centres, tracks.position_m, atol=1e-6)
    assert last == [], "drones without a place are not shown"
    words = [word[0] for word in entities["/status/1"]["StateChange:state"][1]]
    assert words == ["tracked", "coasting", "tracked"]
    # Lines have the colours of the drones; a lost drone has none.
    line = entities["/plots/deviation_mm"]
    assert line["SeriesLines:colors"][1][0] == body["Boxes3D:colors"][1][0]
    expected_mm = np.full((NUM_FRAMES + 1, 2), 1e3 * np.sqrt(0.0056))
    expected_mm[LOST_FROM:, 0] = np.nan
    expected_mm[NUM_FRAMES] = np.nan
    np.testing.assert_allclose(line["Scalars:scalars"][1], expected_mm, rtol=1e-6)
    # A trail begins with the drone and gets longer.
    trails = entities["/world/drones/trail"]["LineStrips3D:strips"][1]
    np.testing.assert_allclose(trails[-2], tracks.position_m.swapaxes(0, 1), atol=1e-6)
    assert entities["/plots/delay_ms"]["Scalars:scalars"][1] == [[20.0]] * NUM_FRAMES
    assert "/world/cameras/c0" in entities

"""`psotrack view`: what is in its files by Rerun's own reader, in a browser and live, and what the machine lacks."""

from __future__ import annotations

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
from helpers import Output, assert_refused, drawn_silhouettes, listening_at
from rerun.chunk import RrdReader
from worlds import (
    CAMERAS,
    COASTING,
    IMAGE_SIZE_WH,
    LOST_FROM,
    NUM_FRAMES,
    REFERENCE,
    make_tracks,
    make_tracks_file,
)

from psotrack.geometry import project
from psotrack.geometry.rig_files import read_rig
from psotrack.recordings import OnboardVideo, VideoWriter, probe, read_frames, view_in_images
from psotrack.show.flights import read_flight
from psotrack.show.viewer import LiveView, ViewContent, write_flight
from psotrack.trajectories import write_trajectories

#: Frames in which a drone is shown that is lost at the end.
UNTIL_LOST = range(LOST_FROM)


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
    return drawn_silhouettes(read_rig(world / "flight" / "rig.toml"), make_tracks().position_m, size_m, 2)


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


def test_status_is_shown_by_words_and_colours(saved):
    body = saved["/world/drones/1/body"]
    labels = [row[0] for row in body["Boxes3D:labels"][1]]
    assert labels[COASTING] == ["1 coasting"] * 2
    assert set(labels[: COASTING.start] + labels[COASTING.stop :]) == {"1"}
    colours = np.array(body["Boxes3D:colors"][1])[:, 0]
    assert len(set(colours[COASTING])) == 1
    assert set(colours[COASTING]).isdisjoint(colours[: COASTING.start])
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
        images, masks, blobs = (
            saved[f"/world/cameras/{name}/{part}"] for part in ("image", "silhouettes", "blobs")
        )
        assert images["EncodedImage:blob"][0] == list(range(NUM_FRAMES))
        filmed = read_frames(flight.recording.videos[name])
        for frame, before in enumerate(filmed):
            # Noise of 30 levels loses some of them in JPEG; another frame differs by 12 on average.
            image, mask = (decoded(each["EncodedImage:blob"][1][frame]) for each in (images, masks))
            assert np.abs(image.astype(float) - before).mean() < 6
            # As opaque as a cell is covered, up to 55 %, and without colour where nothing is.
            np.testing.assert_allclose(mask[..., 3], 0.55 * coverage[frame], atol=1)
            assert (mask[coverage[frame] == 0] == 0).all()
            assert (mask[coverage[frame] > 0][:, :3] == [0, 255, 170]).all()
            # Boxes of blobs hold the covered cells, of two pixels.
            rows, columns = np.nonzero(coverage[frame] > 128)
            centres, halves = (
                np.array(blobs[f"Boxes2D:{part}"][1][frame]) for part in ("centers", "half_sizes")
            )
            off_px = np.abs(2 * np.stack([columns, rows], axis=1)[:, None] + 1 - centres) - halves
            assert (off_px.max(axis=2).min(axis=1) < 2).all()


def test_boxes_and_ellipses_are_about_the_drones_and_cameras_stand_where_the_rig_says(saved, flight):
    rig, tracks = flight.recording.rig, flight.tracks[0]
    expected = view_in_images(flight.recording, tracks.trajectories, tracks.size_m).boxes_px
    for index, name in enumerate(CAMERAS):
        boxes, camera = saved[f"/world/cameras/{name}/boxes"], saved[f"/world/cameras/{name}"]
        outlines = saved[f"/world/cameras/{name}/ellipses"]["LineStrips2D:strips"][1]
        pixels, _ = project(rig.cameras[index], tracks.trajectories.position_m)
        for frame in range(NUM_FRAMES):
            seen = [0, 1] if frame in UNTIL_LOST else [1]
            assert boxes["Boxes2D:labels"][1][frame] == [str(drone) for drone in seen]
            centres, halves = (boxes[f"Boxes2D:{part}"][1][frame] for part in ("centers", "half_sizes"))
            xyxy = np.hstack([np.subtract(centres, halves), np.add(centres, halves)])
            np.testing.assert_allclose(xyxy, expected[frame, seen, index], atol=1e-3)
            # The outline is symmetric about the drone's pixel, which has its centre half a pixel further in Rerun.
            middles = np.mean(outlines[frame], axis=1, where=np.arange(25)[:, None] < 24)
            np.testing.assert_allclose(middles, pixels[frame, seen] + 0.5, atol=1e-2)
        times, places = camera["Transform3D:translation"]
        assert times == [None]
        np.testing.assert_allclose(places[0][0], rig.cameras[index].centre_world, atol=1e-5)
        K = np.reshape(camera["Pinhole:image_from_camera"][1][0][0], (3, 3)).T
        np.testing.assert_allclose(K[:2, 2], rig.cameras[index].K[:2, 2] + 0.5, atol=1e-4)
        np.testing.assert_array_equal(camera["Pinhole:resolution"][1][0][0], IMAGE_SIZE_WH)


def test_two_files_of_tracks_are_two_colours(run, world, tmp_path):
    other, out = make_tracks_file(tmp_path / "other.csv", 0.05), tmp_path / "both.rrd"
    assert run(world / "tracks.csv", other, "--save", out, "--quiet").code == 0
    entities = read_entities(out)
    colours = [
        [entities[f"/world/drones/{name}/{drone}/body"]["Boxes3D:colors"][1][0][0] for drone in range(2)]
        for name in ("tracks", "other")
    ]
    assert [len(set(each)) for each in colours] == [1, 1]
    assert colours[0] != colours[1]
    assert not any(path.startswith("/world/cameras") for path in entities), "no recording is given"


def test_the_first_frames_of_some_cameras_and_what_the_file_has_is_said(run, world, tmp_path):
    arguments = (world / "tracks.csv", world / "flight", "--frames", 5, "--cameras", "c0,c2")
    code, out, _ = run(*arguments, "--save", tmp_path / "part.rrd")
    assert code == 0
    assert "10 images (every frame, full size)" in out
    assert "--silhouettes computes them" in out
    assert not (tmp_path / "cache").exists()
    entities = read_entities(tmp_path / "part.rrd")
    for path, component in (
        ("cameras/c0/image", "EncodedImage:blob"),
        ("drones/1/body", "Boxes3D:centers"),
        ("truth/dron1/point", "Points3D:positions"),
    ):
        assert entities[f"/world/{path}"][component][0] == list(range(5))
    assert "/world/cameras/c1" not in entities


@pytest.mark.parametrize("share", [0.8, 0.25])
def test_files_are_not_larger_than_demanded(flight, tmp_path, share):
    full = write_flight(tmp_path / "full.rrd", flight, jobs=1)
    bare = write_flight(tmp_path / "bare.rrd", replace(flight, recording=None), jobs=1)
    max_bytes = bare.num_bytes + share * (full.num_bytes - bare.num_bytes)
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
    for path, component in (("body", "Boxes3D:centers"), ("trail", "LineStrips3D:strips")):
        shown = dict(zip(*entities[f"/world/drones/0/{path}"][component], strict=True))
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


#: The program with Ctrl-C as at a terminal: a shell starts programs in the background with Ctrl-C ignored.
HEARS_CTRL_C = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from psotrack.__main__ import main
main()
"""


@pytest.mark.slow
def test_the_page_for_a_browser(start_python, world):
    """The page is served to this computer only, and Ctrl-C ends the command and its server."""
    process = start_python("-c", HEARS_CTRL_C, "view", world / "tracks.csv", "--web")
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
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 96)
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
            view.write(tracks.at_frames(np.array([frame])))
            view.show_delay(0.02)
        last = tracks.at_frames(np.array([NUM_FRAMES - 1]))
        gone = {"position_m": last.position_m * np.nan, "time_s": last.time_s + 0.04}
        view.write(replace(last, frame=last.frame + 1, **gone))
    (port,) = re.findall(r"^http://127\.0\.0\.1:.*%3A(\d+)%2Fproxy", view.page)
    assert addresses == [f"rerun+http://127.0.0.1:{port}/proxy"]
    entities = read_entities(saved)
    # The drones are one entity, which the viewer gets in a tenth of the time of one entity per drone.
    body = entities["/world/drones/body"]
    np.testing.assert_allclose(body["Boxes3D:centers"][1][:-1], tracks.position_m, atol=1e-6)
    assert body["Boxes3D:centers"][1][-1] == [], "drones without a place are not shown"
    words = [word[0] for word in entities["/status/1"]["StateChange:state"][1]]
    assert words == ["tracked", "coasting", "tracked"]
    # Lines have the colours of the drones; a lost drone has none.
    line, deviation = entities["/plots/deviation_mm"], 1e3 * np.sqrt(0.0056)
    assert line["SeriesLines:colors"][1][0] == body["Boxes3D:colors"][1][0]
    expected_mm = np.where(np.arange(NUM_FRAMES + 1)[:, None] < [LOST_FROM, NUM_FRAMES], deviation, np.nan)
    np.testing.assert_allclose(line["Scalars:scalars"][1], expected_mm, rtol=1e-6)
    # A trail begins with the drone and gets longer.
    trails = entities["/world/drones/trail"]["LineStrips3D:strips"][1]
    np.testing.assert_allclose(trails[-2], tracks.position_m.swapaxes(0, 1), atol=1e-6)
    assert entities["/plots/delay_ms"]["Scalars:scalars"][1] == [[20.0]] * NUM_FRAMES
    assert "/world/cameras/c0" in entities

"""`psotrack overlay`: what is drawn where, numbers of frames, interrupted runs, and codecs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from helpers import with_cameras
from worlds import CAMERAS, IMAGE_SIZE_WH, LOST_FROM, NUM_FRAMES, RATE_HZ, make_tracks

from psotrack.errors import OutputError
from psotrack.recordings import VideoWriter, probe, read_frames, view_in_images
from psotrack.show.flights import status_rgb
from psotrack.show.overlay import Codec, OverlayOptions, find_codec, write_overlays
from psotrack.support import COLOURS
from psotrack.trajectories import Status

SHOWN = (Status.TRACKED, Status.COASTING)


def colour_bgr(drone, status):
    return status_rgb(np.array([int(status)]), [COLOURS[drone]], lighter=0.2)[0, ::-1].astype(float)


def off_colour(image, box_px, colour):
    """Smallest difference of a pixel about the middle of the box's lower edge from a colour, of 255."""
    column, row = round(box_px[[0, 2]].mean()), round(box_px[3] - 0.5)
    near = image[row - 2 : row + 3, column - 3 : column + 4].reshape(-1, 3).astype(float)
    return np.abs(near - colour).mean(axis=1).min()


def boxes_px(flight):
    tracks = flight.tracks[0]
    return view_in_images(flight.recording, tracks.trajectories, tracks.size_m).boxes_px


@pytest.fixture
def run(run_psotrack, world, tmp_path):
    """Runs `psotrack overlay` with some options for the flight, whose videos are in `videos`: what it prints."""

    def run(*options):
        words = (world / "tracks.csv", world / "flight", "--out", tmp_path / "videos", "--jobs", 1, *options)
        done = run_psotrack("overlay", *words)
        assert (done.code, done.err) == (0, "")
        return done.out

    return run


#: Options -> size of an image per size of its camera, and the corner of each camera's image in its video.
LAYOUTS = {
    (): (1.0, [(0, 0)] * 3),
    ("--scale", 1.5): (1.5, [(0, 0)] * 3),
    # Three cameras and the map are two columns of 960 pixels; the images are 4 to 3.
    ("--mosaic",): (3.0, [(0, 0), (960, 0), (0, 720)]),
}


@pytest.mark.parametrize("options", LAYOUTS)
def test_boxes_are_drawn_where_the_drones_are(run, flight, tmp_path, options):
    scale, corners = LAYOUTS[options]
    out, is_mosaic = run(*options), options == ("--mosaic",)
    names = ["mosaic"] * 3 if is_mosaic else CAMERAS
    assert f"{len(set(names))} videos in " in out
    files = {path.name for path in (tmp_path / "videos").iterdir()}
    assert files == {"overlay.json", *(f"{name}.mp4" for name in names)}
    width, height = (round(scale * side) for side in IMAGE_SIZE_WH)
    expected_px = boxes_px(flight) * scale
    status = make_tracks().status
    for index, (name, (left, top)) in enumerate(zip(names, corners, strict=True)):
        video = probe(tmp_path / "videos" / f"{name}.mp4")
        size_wh = (2 * width, 2 * height) if is_mosaic else (width, height)
        assert (video.num_frames, video.fps, video.image_size_wh) == (NUM_FRAMES, RATE_HZ, size_wh)
        for frame, whole in enumerate(read_frames(video)):
            image = whole[top : top + height, left : left + width]
            for drone in range(2):
                if status[frame, drone] == Status.LOST:
                    continue
                # The codec halves the resolution of colours and mixes a line of two pixels with the grey around it.
                off = {
                    other: off_colour(image, expected_px[frame, drone, index], colour_bgr(drone, other))
                    for other in SHOWN
                }
                assert min(off, key=off.get) == status[frame, drone], (name, frame, drone, off)
                assert off[status[frame, drone]] < 40, (name, frame, drone, off)


def test_nothing_is_drawn_without_drones(flight, tmp_path):
    lost = replace(make_tracks(), status=np.full((NUM_FRAMES, 2), int(Status.LOST)))
    flight = replace(flight, tracks=(replace(flight.tracks[0], trajectories=lost),))
    write_overlays(tmp_path, flight, jobs=1)
    given = read_frames(flight.recording.videos["c0"])
    for image, before in zip(read_frames(probe(tmp_path / "c0.mp4")), given, strict=True):
        # Below the heading only the codec changes the image: noise of 30 levels loses some of them.
        assert np.abs(image[40:].astype(float) - before[40:]).mean() < 8


def test_the_map_shows_cameras_and_drones_from_above(flight, tmp_path):
    write_overlays(tmp_path, flight, OverlayOptions(mosaic=True), jobs=1)
    maps = [image[720:, 960:].astype(float) for image in read_frames(probe(tmp_path / "mosaic.mp4"))]
    # Erosion leaves the discs of the drones, and takes their lines and names.
    shown = {}
    for frame in (0, LOST_FROM - 1):
        for drone in range(2):
            near = np.abs(maps[frame] - colour_bgr(drone, Status.TRACKED)).mean(axis=2) < 40
            disc = cv2.erode(near.astype(np.uint8), np.ones((4, 4)))
            shown[frame, drone] = np.argwhere(disc)[:, ::-1].mean(axis=0)
    position_m = make_tracks().position_m[..., :2]
    # The drones are 1.2 m apart along x, to the right, and fly along y, upwards.
    px_per_m = (shown[0, 1] - shown[0, 0])[0] / 1.2
    for (frame, drone), place_px in shown.items():
        moved_m = (position_m[frame, drone] - position_m[0, 0]) * [1, -1]
        # Centres of discs of eight pixels are known to half a pixel.
        np.testing.assert_allclose(place_px, shown[0, 0] + px_per_m * moved_m, atol=1)
    # Trails are as long as the flight, and the words about the grid are in the lower left corner.
    for drone in range(2):
        column, row = ((shown[0, drone] + shown[LOST_FROM - 1, drone]) / 2).round().astype(int)
        near = maps[LOST_FROM - 1][row, column - 2 : column + 3] - colour_bgr(drone, Status.TRACKED)
        assert np.abs(near).mean(axis=1).min() < 60
    assert maps[0][-40:, :150].max() > 150
    # All cameras are on the map, in its middle, which is known to a pixel, five times the drones' distance away.
    centres_m = np.asarray(flight.recording.rig.cameras.centre_world)[:, :2]
    tips_px = shown[0, 0] + px_per_m * (centres_m - position_m[0, 0]) * [1, -1]
    np.testing.assert_allclose((tips_px.min(axis=0) + tips_px.max(axis=0)) / 2, [480, 360], atol=5)
    assert tips_px.min() > 0
    for column, row in tips_px.round().astype(int):
        assert maps[0][row - 6 : row + 7, column - 6 : column + 7].max() > 150, "a grey triangle begins here"


def test_cameras_of_another_shape_keep_their_aspect_ratio_in_the_mosaic(flight, tmp_path):
    """One of three cameras shows the left 200 of 320 columns: its image is narrower, and boxes sit on the drones."""
    recording, index = flight.recording, CAMERAS.index("c1")
    with VideoWriter(tmp_path / "narrow.avi", RATE_HZ, (200, 240)) as writer:
        for frame in read_frames(recording.videos["c1"]):
            writer.write(frame[:, :200].copy())
    sizes_wh = recording.rig.cameras.image_size_wh.copy()
    sizes_wh[index] = 200, 240
    rig = replace(recording.rig, cameras=replace(recording.rig.cameras, image_size_wh=sizes_wh))
    narrow = with_cameras(recording.with_rig(rig), video={"c1": probe(tmp_path / "narrow.avi")})
    flight = replace(flight, recording=narrow)
    write_overlays(tmp_path / "out", flight, OverlayOptions(mosaic=True), jobs=1)
    tile = next(read_frames(probe(tmp_path / "out" / "mosaic.mp4")))[:720, 960:]
    # 200 x 240 pixels in a place of 960 x 720 are three times as large, with 180 black columns at both sides.
    assert tile[:, :170].max() < 40
    assert tile[:, 790:].max() < 40
    narrow_px = boxes_px(flight)[0, :, index]
    shown = np.flatnonzero(narrow_px[:, 2] < 200)
    assert len(shown)
    for drone in shown:
        assert (
            off_colour(tile, narrow_px[drone] * 3 + [180, 0, 180, 0], colour_bgr(drone, Status.TRACKED)) < 40
        )


@pytest.mark.parametrize("change", ["tracks", "lens", "times", "video"])
def test_finished_videos_are_kept_and_those_of_other_inputs_are_refused(flight, tmp_path, change):
    video = tmp_path / "c0.avi"
    video.write_bytes(flight.recording.videos["c0"].path.read_bytes())
    recording = with_cameras(flight.recording.usable(["c0", "c1"], videos=False), video={"c0": probe(video)})
    write = partial(write_overlays, tmp_path / "out", jobs=1)
    assert len(write(replace(flight, recording=recording.usable(["c0"], videos=False))).written) == 1
    flight = replace(flight, recording=recording)
    assert [path.name for path in write(flight).written] == ["c1.mp4"]
    assert len(write(flight).kept) == 2
    if change == "tracks":
        flight = replace(flight, tracks=(replace(flight.tracks[0], trajectories=make_tracks(0.3)),))
    elif change == "lens":
        cameras = replace(recording.rig.cameras, dist=np.zeros((2, 4)), fisheye=np.array([True, False]))
        flight = replace(flight, recording=recording.with_rig(replace(recording.rig, cameras=cameras)))
    elif change == "times":
        late = {"c0": replace(recording.exposed["c0"], time_offset_s=0.01)}
        flight = replace(flight, recording=with_cameras(recording, times=late))
    else:
        video.write_bytes(flight.recording.videos["c1"].path.read_bytes())
    with pytest.raises(OutputError, match=r"c0\.mp4: .*--force"):
        write(flight)
    assert len(write(flight, OverlayOptions(force=True)).written) == 2
    assert len(write(flight).kept) == 2


def test_the_next_codec_is_used_where_the_first_one_fails():
    wrong, right = Codec("none", "zzzz"), Codec("MPEG-4", "mp4v")
    assert find_codec([wrong, right]) == right
    with pytest.raises(OutputError, match="none"):
        find_codec([wrong])

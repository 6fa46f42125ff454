"""`psotrack overlay`: what is drawn where, numbers of frames, interrupted runs, and codecs."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from helpers import with_cameras
from worlds import CAMERAS, IMAGE_SIZE_WH, LOST_FROM, NUM_FRAMES, RATE_HZ, make_tracks

from psotrack.errors import OutputError
from psotrack.recordings import probe, read_frames, view_in_images
from psotrack.show.flights import status_rgb
from psotrack.show.overlay import OverlayOptions, find_codec, write_overlays
from psotrack.support import COLOURS
from psotrack.trajectories import Status


def colour_bgr(drone, status):
    (rgb,) = status_rgb(np.array([int(status)]), [COLOURS[drone]], lighter=0.2)
    return rgb[::-1].astype(float)


def off_colour(image, box_px, colour):
    """Smallest difference of a pixel about the middle of the box's lower edge from a colour, of 255."""
    left, _, right, bottom = box_px
    column = round((left + right) / 2)
    row = round(bottom - 0.5)
    near = image[row - 2 : row + 3, column - 3 : column + 4].astype(float)
    return np.abs(near - colour).mean(axis=2).min()


#: Options -> size of an image per size of its camera, and the corner of each camera's image in its video.
LAYOUTS = {
    (): (1.0, [(0, 0)] * 3),
    ("--scale", 1.5): (1.5, [(0, 0)] * 3),
    # Three cameras and the map are two columns of 960 pixels; the images are 4 to 3.
    ("--mosaic",): (3.0, [(0, 0), (960, 0), (0, 720)]),
}


@pytest.mark.parametrize("options", LAYOUTS)
def test_boxes_are_drawn_where_the_drones_are(run_psotrack, world, flight, tmp_path, options):
    scale, corners = LAYOUTS[options]
    words = (world / "tracks.csv", world / "flight", "--out", tmp_path / "videos", "--jobs", 1, *options)
    done, is_mosaic = run_psotrack("overlay", *words), options == ("--mosaic",)
    names = ["mosaic"] * 3 if is_mosaic else CAMERAS
    assert (done.code, done.err) == (0, "")
    assert f"{len(set(names))} videos in " in done.out
    files = {path.name for path in (tmp_path / "videos").iterdir()}
    assert files == {"overlay.json", *(f"{name}.mp4" for name in names)}
    width, height = (round(scale * side) for side in IMAGE_SIZE_WH)
    tracks = flight.tracks[0]
    views = view_in_images(flight.recording, tracks.trajectories, tracks.size_m)
    expected_px = views.boxes_px * scale
    status = make_tracks().status
    for index, name in enumerate(names):
        video = probe(tmp_path / "videos" / f"{name}.mp4")
        assert (video.num_frames, video.fps) == (NUM_FRAMES, RATE_HZ)
        assert video.image_size_wh == ((2 * width, 2 * height) if is_mosaic else (width, height))
        left, top = corners[index]
        for frame, whole in enumerate(read_frames(video)):
            image = whole[top : top + height, left : left + width]
            for drone in range(2):
                here = status[frame, drone]
                if here == Status.LOST:
                    continue
                # The codec halves the resolution of colours and mixes a line of two pixels with the grey around it.
                box_px = expected_px[frame, drone, index]
                other = Status.COASTING if here == Status.TRACKED else Status.TRACKED
                off = off_colour(image, box_px, colour_bgr(drone, here))
                assert off < 40, (name, frame, drone)
                assert off < off_colour(image, box_px, colour_bgr(drone, other)), (name, frame, drone)


def test_the_map_shows_cameras_and_drones_from_above(flight, tmp_path):
    write_overlays(tmp_path, flight, OverlayOptions(mosaic=True), jobs=1)
    frames = list(read_frames(probe(tmp_path / "mosaic.mp4")))
    maps = np.array(frames)[:, 720:, 960:].astype(float)
    # Erosion leaves the discs of the drones, and takes their lines and names.
    shown = {}
    last = LOST_FROM - 1
    for frame in (0, last):
        for drone in range(2):
            off = np.abs(maps[frame] - colour_bgr(drone, Status.TRACKED)).mean(axis=2)
            near = (off < 40).astype(np.uint8)
            disc = cv2.erode(near, np.ones((4, 4)))
            row, column = np.argwhere(disc).mean(axis=0)
            shown[frame, drone] = np.array([column, row])
    position_m = make_tracks().position_m[..., :2]
    # The drones are 1.2 m apart along x, to the right, and fly along y, upwards.
    px_per_m = (shown[0, 1] - shown[0, 0])[0] / 1.2
    for (frame, drone), place_px in shown.items():
        moved_m = (position_m[frame, drone] - position_m[0, 0]) * [1, -1]
        # Centres of discs of eight pixels are known to half a pixel.
        np.testing.assert_allclose(place_px, shown[0, 0] + px_per_m * moved_m, atol=1)
    # Trails are as long as the flight, and the words about the grid are in the lower left corner.
    for drone in range(2):
        middle_px = (shown[0, drone] + shown[last, drone]) / 2
        column, row = middle_px.round().astype(int)
        trail = maps[last, row, column - 2 : column + 3]
        off = np.abs(trail - colour_bgr(drone, Status.TRACKED)).mean(axis=1)
        assert off.min() < 60
    assert maps[0, -40:, :150].max() > 150
    # All cameras are on the map, in its middle, which is known to a pixel, five times the drones' distance away.
    centres_m = np.asarray(flight.recording.rig.cameras.centre_world)[:, :2]
    tips_px = shown[0, 0] + px_per_m * (centres_m - position_m[0, 0]) * [1, -1]
    low_px, high_px = tips_px.min(axis=0), tips_px.max(axis=0)
    np.testing.assert_allclose((low_px + high_px) / 2, [480, 360], atol=5)
    assert low_px.min() > 0
    for column, row in tips_px.round().astype(int):
        near = maps[0, row - 6 : row + 7, column - 6 : column + 7]
        assert near.max() > 150, "a grey triangle begins here"


def test_finished_videos_are_kept_and_those_of_other_inputs_are_refused(flight, tmp_path):
    video = tmp_path / "c0.avi"
    video.write_bytes(flight.recording.videos["c0"].path.read_bytes())
    recording = with_cameras(flight.recording.usable(["c0", "c1"], videos=False), video={"c0": probe(video)})
    alone = replace(flight, recording=recording.usable(["c0"], videos=False))
    flight = replace(flight, recording=recording)
    write = partial(write_overlays, tmp_path / "out", jobs=1)
    assert len(write(alone).written) == 1
    assert [path.name for path in write(flight).written] == ["c1.mp4"]
    assert len(write(flight).kept) == 2
    higher = replace(flight.tracks[0], trajectories=make_tracks(0.3))
    lenses = replace(recording.rig.cameras, dist=np.zeros((2, 4)), fisheye=np.array([True, False]))
    fisheye = recording.with_rig(replace(recording.rig, cameras=lenses))
    late = replace(recording.exposed["c0"], time_offset_s=0.01)
    for changed in (
        replace(flight, tracks=(higher,)),
        replace(flight, recording=fisheye),
        replace(flight, recording=with_cameras(recording, times={"c0": late})),
    ):
        with pytest.raises(OutputError, match=r"c0\.mp4: .*--force"):
            write(changed)
    assert len(write(flight).kept) == 2
    video.write_bytes(flight.recording.videos["c1"].path.read_bytes())
    with pytest.raises(OutputError, match=r"c0\.mp4: .*--force"):
        write(flight)
    assert len(write(flight, OverlayOptions(force=True)).written) == 2
    assert len(write(flight).kept) == 2


def test_the_next_codec_is_used_where_the_first_one_fails():
    assert find_codec(["zzzz", "mp4v"]) == "mp4v"
    with pytest.raises(OutputError, match="zzzz"):
        find_codec(["zzzz"])

"""Sightings as arrays, from the boxes of a detector and from blobs of foreground."""

import numpy as np
from helpers import draw_coverage, ring_rig

from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import project
from psotrack.recordings import Detections
from psotrack.tracking.matching import from_detections, from_silhouettes

RIG = ring_rig(8, coefficients=4, image_size_wh=(1920, 1080))


def test_a_sighting_is_at_the_middle_of_its_box_and_is_less_certain_at_the_image_border():
    boxes = np.array([[10.0, 20.0, 30.0, 60.0], [0.0, 20.0, 20.0, 60.0]])
    given = {RIG.names[2]: Detections(np.array([1, 1]), boxes, np.ones(2))}
    sightings = from_detections(given, RIG, 3)
    assert sightings.centre_px.shape == (3, 8, 2, 2)
    # The box covers columns 10 to 29; the middle of column 0 is at 0, so the box's middle is at 19.5.
    np.testing.assert_array_equal(sightings.centre_px[1, 2], [[19.5, 39.5], [9.5, 39.5]])
    np.testing.assert_array_equal(sightings.size_px[1, 2], [[20, 40], [20, 40]])
    assert sightings.noise_px[1, 2, 1] > 3 * sightings.noise_px[1, 2, 0]
    assert np.isnan(sightings.centre_px[[0, 2]]).all()
    assert np.isnan(np.delete(sightings.noise_px[1], 2, axis=0)).all()


def test_boxes_of_frames_that_no_video_has_do_not_count():
    given = {RIG.names[0]: Detections(np.array([5]), np.array([[10.0, 20.0, 30.0, 60.0]]), np.ones(1))}
    assert np.isnan(from_detections(given, RIG, 3).centre_px).all()


def test_blobs_of_silhouettes_are_sightings():
    rig, reduction, position_m = ring_rig(4), 2, np.array([[0.2, -0.3, 1.2]])
    image = draw_coverage(rig, position_m, [0.6, 0.6, 0.6], reduction)
    silhouettes = Silhouettes(
        cameras=rig.names,
        keys=dict.fromkeys(rig.names, "drawn"),
        reduction=reduction,
        num_frames=30,
        shape=image.shape[1:],
        seconds={"decode": 0.0, "foreground": 0.0},
        arrays=tuple(np.repeat(one[None], 30, axis=0) for one in image),
    )
    sightings = from_silhouettes(silhouettes)
    assert sightings.centre_px.shape == (30, 4, 1, 2)
    # The image of a sphere is not exactly centred on the image of its middle, and cells are 2 px wide.
    np.testing.assert_allclose(sightings.centre_px[-1, :, 0], project(rig.cameras, position_m)[0], atol=1.5)

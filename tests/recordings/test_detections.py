"""Detection files: reading, writing and reading again, and errors that name the line."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psotrack.errors import InputError
from psotrack.recordings import Detections, read_detections, write_detections

LINE = "4,10,20,30,40,25,40,0.9"


def write_file(tmp_path, text, name="cam1i_s.csv"):
    path = tmp_path / name
    path.write_bytes(text.encode())
    return path


def test_a_file_is_read(tmp_path):
    detections = read_detections(write_file(tmp_path, f"{LINE}\n7\n9,{LINE[2:]},1,2,3,4,2.5,4,0.25\n"))
    assert detections.frame.tolist() == [4, 9, 9]
    assert detections.xyxy.tolist() == [[10, 20, 40, 60], [10, 20, 40, 60], [1, 2, 4, 6]]
    assert detections.confidence.tolist() == [0.9, 0.9, 0.25]
    assert detections.in_frame(9).confidence.tolist() == [0.9, 0.25]
    assert len(detections.in_frame(7)) == 0


def test_x_and_y_may_be_the_middle(tmp_path):
    """Some exports of YOLO have the middle of the box as x and y; the box that is read is the same."""
    detections = read_detections(write_file(tmp_path, "0,25,40,30,40,25,40,0.9"))
    assert detections.xyxy.tolist() == [[10, 20, 40, 60]]


@pytest.mark.parametrize(
    "text",
    [
        f"\ufeff{LINE}\n",
        f"{LINE}\r\n\r\n",
        f"\n\n{LINE},\n\n",
        LINE.replace(",", " , "),
        f"{LINE}\n2,{LINE[2:]}".replace("\n2", "\n2.0"),
        f"{LINE},,,,\n2,{LINE[2:]}{7 * ','}\n3,,,,\n,,,,",
        f"{LINE},,,,,,,,{LINE[2:]}",
    ],
    ids=[
        "byte order mark",
        "Windows",
        "blank lines and last comma",
        "spaces",
        "out of order, frame as 2.0",
        "padded with empty fields",
        "an empty detection between two",
    ],
)
def test_variants_of_the_format_are_read(tmp_path, text):
    detections = read_detections(write_file(tmp_path, text))
    assert set(detections.frame.tolist()) <= {2, 4}
    assert np.all(np.diff(detections.frame) >= 0)
    np.testing.assert_array_equal(detections.xyxy, [[10, 20, 40, 60]] * len(detections))


def test_no_detections_at_all(tmp_path):
    assert len(read_detections(write_file(tmp_path, ""))) == 0


@pytest.mark.parametrize(
    ("broken", "expected"),
    [
        ("5,1,2,3,4,5,6", "line 2: expected a frame number and 7 values per detection .*, found 6 values"),
        ("5,1,2,3,4,5,6,x", "line 2, column 8: expected a number, found 'x'"),
        ("5,1,2,,4,5,6,0.5", "line 2, column 4: expected a value, found nothing"),
        ("5,1,2,nan,4,5,6,0.5", "line 2, column 4: expected a finite number, found 'nan'"),
        ("5,1,2,-3,4,5,6,0.5", "line 2, column 4: expected a size w of 0 or more pixels, found -3"),
        ("5,1,2,3,4,5,6,1.5", "line 2, column 8: expected a confidence from 0 to 1, found 1.5"),
        ("5.5,1,2,3,4,5,6,0.5", "line 2, column 1: expected a whole number, 0 or more, found '5.5'"),
        ("-1,1,2,3,4,5,6,0.5", "line 2, column 1: expected a whole number, 0 or more, found '-1'"),
        (LINE, "line 2, column 1: expected each frame once, found frame 4 again"),
        (LINE.replace(",", ";"), "line 2, column 1: expected a number"),
    ],
)
def test_a_broken_line_is_named(tmp_path, broken, expected):
    with pytest.raises(InputError, match=rf"cam1i_s\.csv, {expected}"):
        read_detections(write_file(tmp_path, f"{LINE}\n{broken}\n"))


def test_a_file_that_is_not_text_is_refused(tmp_path):
    path = tmp_path / "cam1i_s.csv"
    path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError, match=r"cam1i_s\.csv: expected UTF-8 text, found an invalid byte"):
        read_detections(path)


pixels = st.floats(-1e4, 1e4)
boxes = st.tuples(pixels, pixels, st.floats(0, 1e4), st.floats(0, 1e4), st.floats(0, 1))


@given(found=st.lists(st.tuples(st.integers(0, 9), boxes), max_size=12))
def test_detections_are_read_as_they_were_written(tmp_path_factory, found):
    found = sorted(found, key=lambda item: item[0])
    values = np.array([box for _, box in found], np.float64).reshape(-1, 5)
    xyxy = np.hstack([values[:, :2], values[:, :2] + values[:, 2:4]])
    detections = Detections(np.array([frame for frame, _ in found], np.int64), xyxy, values[:, 4])
    path = tmp_path_factory.getbasetemp() / "round_trip.csv"
    write_detections(path, detections)
    again = read_detections(path)
    np.testing.assert_array_equal(again.frame, detections.frame)
    # The file has a corner and a size per box: a few roundings of numbers up to 2e4.
    np.testing.assert_allclose(again.xyxy, detections.xyxy, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(again.confidence, detections.confidence)


def test_frames_must_be_in_order():
    with pytest.raises(InputError, match="expected increasing frame numbers, found steps back"):
        Detections(np.array([3, 2]), np.zeros((2, 4)), np.zeros(2))

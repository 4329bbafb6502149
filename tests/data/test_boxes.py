"""Face boxes: their laws and their file."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxfit.data.boxes import bounding_square, box_centre, box_problem, jitter, read_boxes
from jaxfit.errors import InputError

POINTS = arrays(np.float64, st.tuples(st.integers(1, 9), st.just(2)), elements=st.floats(-1e4, 1e4))


@given(POINTS)
def test_the_square_holds_the_points_tightly(points):
    square = bounding_square(points)
    low, high = points.min(0), points.max(0)
    assert square[2] == square[3] == (high - low).max()
    np.testing.assert_allclose(box_centre(square), (low + high) / 2, atol=1e-9)


def test_unknown_points_do_not_count():
    points = np.array([[0.0, 0.0], [4.0, 2.0]])
    with_unknown = np.vstack([points, [[np.nan, np.nan], [np.nan, 99.0], [np.inf, 0.0]]])
    np.testing.assert_array_equal(bounding_square(with_unknown), [0, -1, 4, 4])
    with pytest.raises(InputError, match="at least one"):
        bounding_square(np.full((3, 2), np.nan))


def test_jitter_has_the_spread_it_promises():
    rng = np.random.default_rng(0)
    box = np.array([100.0, -50.0, 200.0, 200.0])
    boxes = np.array([jitter(box, rng, shift=0.06, scale=0.08) for _ in range(20_000)])
    shifts = (boxes[:, :2] + boxes[:, 2:] / 2 - box_centre(box)) / 200
    logs = np.log(boxes[:, 2:] / 200)
    np.testing.assert_allclose(shifts.std(0), 0.06, rtol=0.03)
    np.testing.assert_allclose(shifts.mean(0), 0, atol=0.002)
    np.testing.assert_allclose(logs.std(0), 0.08, rtol=0.03)
    np.testing.assert_allclose(logs.mean(0), 0, atol=0.003)
    np.testing.assert_allclose(boxes[:, 2], boxes[:, 3])


def test_jitter_of_nothing_is_the_box_and_seeds_repeat():
    box = np.array([1.0, 2.0, 30.0, 40.0])
    np.testing.assert_allclose(jitter(box, np.random.default_rng(0), 0.0, 0.0), box)
    one, other = (jitter(box, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("box", "reason"),
    [
        ((np.nan, 0, 5, 5), "not a finite"),
        ((0, 0, np.inf, 5), "not a finite"),
        ((0, 0, 0, 5), "no area"),
        ((0, 0, 5, -1), "no area"),
        ((0, 0, 1e-4, 5), "no area"),
        ((0, 0, 5, 1e-320), "no area"),
        ((0, 0, 2e6, 5), "over 1,000,000 pixels large"),
        ((1.7e308, 0, 1.7e308, 5), "over 1,000,000 pixels large"),
        ((1.7e308, 0, 5, 5), "outside"),
        ((-1e6 + 1, 0, 1e6, 1e6), None),
        ((100, 0, 5, 5), "outside the 100 x 50 picture"),
        ((0, 50, 5, 5), "outside"),
        ((-5, 0, 5, 5), "outside"),
        ((0, -9, 5, 5), "outside"),
        ((0, 0, 5, 5), None),
        ((-4, -4, 5, 5), None),
        ((99, 49, 500, 500), None),
        ((-1000, -1000, 5000, 5000), None),
    ],
)
@pytest.mark.parametrize("channels", [(), (3,)])
def test_boxes_are_refused_with_a_reason(box, reason, channels):
    problem = box_problem(np.array(box, float), (50, 100, *channels))
    assert (problem is None) if reason is None else (reason in problem)


def test_boxes_are_read_by_what_the_file_calls_the_picture(tmp_path):
    path = tmp_path / "boxes.csv"
    path.write_text(
        '\ufeffwidth,image,x,score,y,height\r\n3,a.jpg,1,.9,2,4\r\n1,"b,c.jpg",0,,0,1\n-7,/x/a.jpg,5,,6e0,8\n'
    )
    boxes = read_boxes(path)
    assert list(boxes) == ["a.jpg", "b,c.jpg", "/x/a.jpg"]
    np.testing.assert_array_equal([given.box for given in boxes["/x/a.jpg"]], [[5, 6, -7, 8]])
    assert boxes["b,c.jpg"][0].box.dtype == np.float64
    assert [(given.rotation, given.kind) for given in boxes["a.jpg"]] == [(0, "")]


def test_boxes_may_say_how_faces_are_turned_and_what_drew_them(tmp_path):
    rows = "image,box,x,y,width,height,rotation\na.jpg,yunet,1,2,3,4,-30.5\na.jpg,,1,2,3,4,0\n"
    (tmp_path / "boxes.csv").write_text(rows)
    boxes = read_boxes(tmp_path / "boxes.csv")["a.jpg"]
    assert [(given.rotation, given.kind) for given in boxes] == [(-30.5, "yunet"), (0, "")]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "line 1: expected the columns"),
        ("image,x,y,w,h\n", "line 1: .*no width, height"),
        ("image,x,y,width,height\na,1,2,3,4\nb,1,2,three,4\n", "line 3: .*three"),
        ("image,x,y,width,height\na,1,2,3,4_5\n", "line 2: .*4_5"),
        ("image,x,y,width,height\na,1,2\n", "line 2"),
        ("image,x,y,width,height\na,1,2,3,\n", "line 2"),
        ("image,x,y,width,height\n,1,2,3,4\n", "line 2: .*file name"),
        ("image,x,y,width,height\na,1,2,3,4\nb,nan,2,3,4\n", "line 3: expected finite .*nan, 2"),
        ("image,x,y,width,height\na,1,2,inf,4\n", "line 2: expected finite"),
        ("image,x,y,width,height\na,1,2,3,1e999\n", "line 2: expected finite"),
        ("x,y,width,height,image\n1,2,3,4,a\n1,2,3,4\n", "line 3: .*file name"),
        ("x,y,width,height,image\n1,2\n", "line 2"),
        ("image,x,y,width,height,rotation\na,1,2,3,4,left\n", "line 2: .*left"),
        ("image,x,y,width,height,rotation\na,1,2,3,4,inf\n", "line 2: expected finite"),
        ("image,x,y,width,height,rotation\na,1,2,3,4,\n", "line 2: expected finite"),
    ],
)
def test_damaged_box_files_are_refused_with_the_line(tmp_path, text, reason):
    (tmp_path / "boxes.csv").write_text(text)
    with pytest.raises(InputError, match=rf"boxes\.csv, {reason}"):
        read_boxes(tmp_path / "boxes.csv")


def test_missing_and_binary_box_files(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        read_boxes(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match="CSV"):
        read_boxes(tmp_path / "binary.csv")

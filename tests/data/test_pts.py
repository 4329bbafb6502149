"""iBUG's annotations: what is written is read, and what is wrong is said."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxfit.data.pts import read_pts, write_pts
from jaxfit.errors import DatasetError, InputError

POINTS = np.array([[0.0, 0.0], [10.5, -3.25], [1234.125, 7.0]])
HEADER = "version: 1\nn_points: 2\n{\n1 2\n3 4.5\n}\n"


@pytest.mark.parametrize("base", [0, 1])
def test_written_points_are_read_back(tmp_path, base):
    write_pts(tmp_path / "a.pts", POINTS, base)
    np.testing.assert_allclose(read_pts(tmp_path / "a.pts", base), POINTS, atol=1e-12)
    assert f"\n{base:.3f} {base:.3f}\n" in (tmp_path / "a.pts").read_text()


@given(arrays(np.float64, (4, 2), elements=st.floats(-1e5, 1e5)), st.sampled_from([0, 1]))
def test_text_survives_reading_and_writing(tmp_path_factory, points, base):
    folder = tmp_path_factory.mktemp("pts")
    write_pts(folder / "a.pts", points, base)
    write_pts(folder / "b.pts", read_pts(folder / "a.pts", base), base)
    assert (folder / "a.pts").read_text() == (folder / "b.pts").read_text()
    np.testing.assert_allclose(read_pts(folder / "a.pts", base), points, atol=0.000501)


@pytest.mark.parametrize(
    "text",
    [
        HEADER,
        HEADER.replace("\n", "\r\n"),
        "\ufeff" + HEADER,
        "version:1\nN_POINTS : 2\n{\n\n 1\t2 \n3 4.5\n}",
        "1 2\n3 4.5\n",
        "1.0 2.0\n3e0 4.5",
        "# by hand: 2020\n"
        + HEADER.replace("3 4.5", "# eyes\n3 4.5 # the left: one").replace("points: 2", "points: 2 # all"),
    ],
)
def test_spellings_of_the_same_points(tmp_path, text):
    (tmp_path / "a.pts").write_bytes(text.encode())
    np.testing.assert_array_equal(read_pts(tmp_path / "a.pts"), [[0, 1], [2, 3.5]])
    np.testing.assert_array_equal(read_pts(tmp_path / "a.pts", base=0), [[1, 2], [3, 4.5]])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (HEADER.replace("n_points: 2", "n_points: 3"), "says n_points: 3 but lists 2"),
        (HEADER.replace("3 4.5", "3 four"), "line 5.*'3 four'"),
        (HEADER.replace("3 4.5", "3"), "line 5"),
        (HEADER.replace("3 4.5", "nan 1"), "line 5.*finite"),
        (HEADER.replace("3 4.5", "3 4_5"), "line 5.*'3 4_5'"),
        (HEADER.replace("3 4.5", "３ 4.5"), "line 5.*'３ 4.5'"),
        ("1 2\n3:4.5 1\n", "line 2.*'3:4.5 1'"),
        ("nan nan\nnan nan\n", "none that is not missing"),
        (HEADER.replace("3 4.5", "1 inf"), "line 5.*finite"),
        ("version: 1\nn_points: 0\n{\n}\n", "no points"),
        ("", "no points"),
    ],
)
def test_damaged_files_are_refused_with_the_place(tmp_path, text, reason):
    (tmp_path / "a.pts").write_text(text)
    with pytest.raises(DatasetError, match=reason):
        read_pts(tmp_path / "a.pts")


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(DatasetError, match=r"a\.pts.*No such file"):
        read_pts(tmp_path / "a.pts")
    (tmp_path / "a.pts").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(DatasetError, match="not UTF-8"):
        read_pts(tmp_path / "a.pts")


def test_wrong_arguments(tmp_path):
    with pytest.raises(InputError, match="0 or 1"):
        read_pts(tmp_path / "a.pts", base=2)
    with pytest.raises(InputError, match="finite"):
        write_pts(tmp_path / "a.pts", np.full((3, 2), np.nan))
    with pytest.raises(InputError, match=r"\(3, 3\)"):
        write_pts(tmp_path / "a.pts", np.zeros((3, 3)))
    assert not list(tmp_path.iterdir())

"""Drawings change what they should and nothing else."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from jaxfit.data.contact_sheet import _in_ascii
from jaxfit.data.overlays import draw_head, draw_landmarks, draw_name
from jaxfit.errors import ImageError, InputError
from jaxfit.schemes.known import AFLW21, IBUG68
from jaxfit.schemes.scheme import Scheme

POINT = Scheme(name="points1", count=1)
CYAN, RED = [0, 255, 255], [255, 60, 60]
AXES = [255, 0, 0], [0, 230, 0], [40, 90, 255]
HEAD_BOX = [255, 70, 200], [150, 60, 130]
DOTS = replace(IBUG68, lines=())
POSES = [(0, 0, 0), (25, 0, 0), (0, 30, 0), (0, 0, 40), (-20, 15, -50), (10, -35, 80), (170, 20, 130)]


def ring(count, centre, radius):
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return centre + radius * np.stack([np.cos(angles), np.sin(angles)], 1)


def test_the_picture_itself_stays_and_grey_becomes_rgb():
    grey = np.full((50, 60), 9, np.uint8)
    drawn = draw_landmarks(grey, ring(68, [30, 25], 20), IBUG68)
    assert drawn.shape == (50, 60, 3)
    assert (grey == 9).all()
    rgb = np.dstack([grey] * 3)
    np.testing.assert_array_equal(draw_landmarks(rgb, ring(68, [30, 25], 20), IBUG68), drawn)
    assert (rgb == 9).all()


def test_points_lie_where_they_belong_to_a_fraction_of_a_pixel():
    drawn = draw_landmarks(np.zeros((40, 40), np.uint8), np.array([[20.5, 11.25]]), POINT)
    weights = drawn[..., 1] / drawn[..., 1].sum()
    y, x = np.mgrid[:40, :40]
    np.testing.assert_allclose([(weights * x).sum(), (weights * y).sum()], [20.5, 11.25], atol=0.2)


def test_colours_and_what_lies_on_top():
    black = np.zeros((40, 40), np.uint8)
    here, there = np.array([[10.0, 10.0]]), np.array([[30.0, 30.0]])
    drawn = draw_landmarks(black, here, POINT, truth=there)
    assert drawn[10, 10].tolist() == CYAN
    assert drawn[30, 30].tolist() == RED
    assert draw_landmarks(black, here, POINT, truth=here)[10, 10].tolist() == CYAN
    boxed = draw_landmarks(black, here, POINT, box=np.array([5.0, 6.0, 20.0, 30.0]))
    assert all(boxed[y, x].any() for x, y in ((5, 6), (25, 6), (5, 36), (25, 36), (15, 6)))
    assert not boxed[20, 15].any()


@pytest.mark.parametrize("size", [60, 600, 3000])
def test_faces_are_drawn_as_boldly_whatever_the_resolution(size):
    drawn = draw_landmarks(np.zeros((size, size), np.uint8), ring(68, size / 2, size / 3), IBUG68)
    assert 0.01 < (drawn.max(2) > 100).mean() < 0.2


def test_small_faces_are_not_hidden_by_their_landmarks():
    for size in (45, 85):
        drawn = draw_landmarks(np.zeros((size, size), np.uint8), ring(68, size / 2, size / 3), IBUG68)
        assert 0.02 < (drawn.max(2) > 100).mean() < 0.12
    assert draw_landmarks(np.zeros((9, 9), np.uint8), np.array([[4.0, 4.0]]), POINT)[4, 4].tolist() == CYAN


@pytest.mark.parametrize("name", ["1", "12: 0.34"])
@pytest.mark.parametrize("corner", [(0, 0), (-30, -30), (190, 0), (0, 160), (250, 170), (80, 2)])
def test_names_of_faces_at_the_edges_are_whole(corner, name):
    def letters(corner):
        drawn = draw_name(np.full((180, 240), 128, np.uint8), name, np.array([*corner, 60.0, 60.0]))
        return [np.sort(drawn[(drawn != 128).any(2)], axis=0).tolist()]

    assert letters(corner) == letters((80, 90))


def test_unknown_and_distant_points_are_survived():
    points = ring(21, [25, 25], 20)
    points[4:18] = np.nan
    points[19] = [1e300, -1e300]
    drawn = draw_landmarks(np.zeros((50, 50), np.uint8), points, AFLW21)
    assert drawn.any()
    nothing = draw_landmarks(np.zeros((50, 50), np.uint8), np.full((21, 2), np.nan), AFLW21, box=np.full(4, np.nan))
    assert not nothing.any()


def test_landmarks_must_fit_the_scheme():
    with pytest.raises(InputError, match=r"\(68, 2\).*ibug68.*\(21, 2\)"):
        draw_landmarks(np.zeros((50, 50), np.uint8), np.zeros((21, 2)), IBUG68)


def pixels(picture, colour):
    """x, y of all pixels of exactly this colour, (N, 2)."""
    return np.argwhere((picture == colour).all(-1))[:, ::-1].astype(float)


def turned(pose):
    """Eq. 15's rotation by scipy, whose angles about x turn the other way."""
    roll, pitch, yaw = pose
    return Rotation.from_euler("YXZ", [yaw, -pitch, roll], degrees=True).as_matrix()


def head(pose, size=100, centre=(200, 200)):
    """A ring of some size and, before it, a nose; their mean lies at the centre."""
    points = np.vstack([np.hstack([ring(67, 0, size / 2), np.zeros((67, 1))]), [0, 0, -0.4 * size]])
    return (points - points.mean(0)) @ turned(pose).T + [*centre, 0]


def black(size=400):
    return np.zeros((size, size, 3), np.uint8)


@cache
def large(pose):
    """A head whose thinnest lines still have pixels of their exact colour, and its picture, whose centre is its own."""
    points = head(pose, 700, (900, 900))
    drawn = draw_head(black(1800), points, np.array(pose, float), DOTS)
    for array in (points, drawn):
        array.flags.writeable = False
    return points, drawn


def test_heads_are_drawn_on_a_copy_and_grey_becomes_rgb():
    grey = np.full((400, 400), 9, np.uint8)
    drawn = draw_head(grey, head((5, 5, 5)), np.full(3, 5.0), IBUG68)
    assert (drawn.shape, drawn.dtype) == ((400, 400, 3), np.uint8)
    assert (grey == 9).all()
    rgb = np.dstack([grey] * 3)
    np.testing.assert_array_equal(draw_head(rgb, head((5, 5, 5)), np.full(3, 5.0), IBUG68), drawn)
    assert (rgb == 9).all()
    assert (drawn[:80] == 9).all()
    assert (drawn[320:] == 9).all()


@pytest.mark.parametrize("pose", POSES)
def test_axes_end_where_eq_15_turns_them(pose):
    _, drawn = large(pose)
    tips = 0.6 * 700 * (turned(pose) * [1, 1, -1])[:2].T
    for index, (colour, tip) in enumerate(zip(AXES, tips, strict=True)):
        seen, length = pixels(drawn, colour) - 900, np.linalg.norm(tip)
        if np.linalg.norm(np.delete(tips, index, 0) - tip, axis=1).min() > 50 and length > 50:
            along = tip / length
            assert (seen @ along).max() == pytest.approx(length, abs=25)  # dots are drawn around the tips
            assert abs(seen @ [-along[1], along[0]]).max() < 25


def test_a_face_looks_where_its_blue_axis_points():
    def tip(**turn):
        pose = np.array([0.0, turn.get("pitch", 0.0), turn.get("yaw", 0.0)])
        seen = pixels(draw_head(black(), head(pose), pose, DOTS), AXES[2]) - 200
        return seen[np.linalg.norm(seen, axis=1).argmax()]

    np.testing.assert_allclose(tip(), 0, atol=4)
    assert tip(yaw=40.0)[0] < -30
    assert tip(yaw=-40.0)[0] > 30
    assert tip(pitch=40.0)[1] < -30
    assert tip(pitch=-40.0)[1] > 30


@pytest.mark.parametrize("pose", POSES)
def test_the_head_box_encloses_the_landmarks_and_not_much_more(pose):
    points, drawn = large(pose)
    hull = ConvexHull(np.vstack([pixels(drawn, colour) for colour in HEAD_BOX]))
    beyond = points[:, :2] @ hull.equations[:, :2].T + hull.equations[:, 2]
    assert beyond.max() < -0.05 * 700
    corners = 700 * np.stack(np.meshgrid([-0.6, 0.6], [-0.6, 0.6], [-0.5, 0.7]), -1).reshape(8, 3)
    expected = ConvexHull((corners @ turned(pose).T)[:, :2]).volume
    assert hull.volume == pytest.approx(expected, rel=0.03)


def test_the_front_of_the_head_box_is_where_the_face_looks():
    _, drawn = large((0, 0, 60))
    front, behind = (pixels(drawn, colour) for colour in HEAD_BOX)
    assert front[:, 0].min() < behind[:, 0].min()
    assert front[:, 0].max() < behind[:, 0].max()


def test_near_landmarks_are_brighter_and_lie_on_top():
    far, near = [20.0, 20.0, 30.0], [20.0, 20.0, -30.0]
    pair = Scheme(name="points2", count=2)
    unknown = np.full(3, np.nan)
    for points in ([far, near], [near, far]):
        drawn = draw_head(black(40), np.array(points), unknown, pair)
        assert drawn[20, 20].tolist() == [253, 231, 37]  # the bright end of viridis
    for lines in ((0, 1), (2, 3)), ((2, 3), (0, 1)):
        cross = Scheme(name="points4", count=4, lines=lines)
        points = np.array([[20, 200, -30], [380, 200, -30], [200, 20, 30], [200, 380, 30]], float)
        assert draw_head(black(), points, unknown, cross)[200, 200, 0] > 200  # yellow, not purple
    row = Scheme(name="points5", count=5, lines=((0, 1, 2, 3, 4),))
    points = np.stack([np.linspace(20, 380, 5), np.full(5, 200.0), np.linspace(90, -90, 5)], 1)
    drawn = draw_head(black(), points, unknown, row).astype(float) @ [0.3, 0.6, 0.1]
    dots = drawn[200, [20, 110, 200, 290, 380]]
    lines = drawn[200, [65, 155, 245, 335]]
    assert (np.diff(np.ravel(np.column_stack([dots[:-1], lines]))) > 0).all()
    flat = draw_head(black(), points * [1, 1, 0], unknown, row)
    assert len(np.unique(flat[200, [20, 110, 200, 290, 380]], axis=0)) == 1


def test_labels_and_face_box_lie_below():
    points, drawn = large((0, 0, 0))
    labels, box = points[:, :2], np.array([20.0, 30.0, 1750.0, 1740.0])

    def again(**below):
        return draw_head(black(1800), points, np.zeros(3), DOTS, **below)

    assert again(box=box)[30, 300].any()
    assert len(pixels(again(truth=labels + [40, 40]), RED))
    spot = tuple(np.round(points[5, 1::-1]).astype(int))
    assert drawn[spot].any()
    np.testing.assert_array_equal(again(truth=labels)[spot], drawn[spot])


def test_unknown_and_distant_parts_of_heads_are_survived():
    points, pose, unknown = head((0, 0, 0)), np.zeros(3), np.full(3, np.nan)
    for some_pose in (pose, unknown):
        nothing = draw_head(black(), np.full((68, 3), np.nan), some_pose, IBUG68, box=np.full(4, np.nan))
        assert not nothing.any()
    without_pose = draw_head(black(), points, unknown, IBUG68)
    assert without_pose.any()
    assert not any(len(pixels(without_pose, colour)) for colour in (*AXES, *HEAD_BOX))
    points[3:30, 2] = np.nan
    points[40] = np.inf
    partly = draw_head(black(), points, pose, IBUG68)
    assert len(pixels(partly, AXES[0]))
    assert not partly[int(points[10, 1]), int(points[10, 0])].any()
    points[50] = [1e300, -1e300, 1e300]
    points[51] = [-1.7e308, 1.7e308, -1.7e308]
    assert draw_head(black(), points, np.array([1e6, -1e9, 40.0]), IBUG68).any()
    assert draw_head(black(), np.full((1, 3), 20.0), pose, POINT).any()


def test_heads_must_fit_the_scheme_and_have_a_pose():
    with pytest.raises(InputError, match=r"\(68, 3\).*ibug68.*\(68, 2\)"):
        draw_head(black(), np.zeros((68, 2)), np.zeros(3), IBUG68)
    with pytest.raises(InputError, match=r"pose.*\(2,\)"):
        draw_head(black(), np.zeros((68, 3)), np.zeros(2), IBUG68)


def test_overlays_are_drawn_over_any_picture_and_nothing_else():
    drawn = draw_landmarks(black(), np.full((DOTS.count, 2), 9.0), DOTS)
    alpha = np.dstack([black(), black()[..., :1]])
    for same in (alpha, black().astype(np.uint16), black()[..., 0], np.asfortranarray(black())):
        np.testing.assert_array_equal(draw_landmarks(same, np.full((DOTS.count, 2), 9.0), DOTS), drawn)
    with pytest.raises(ImageError, match="white is 1"):
        draw_landmarks(black() / 255, np.full((DOTS.count, 2), 9.0), DOTS)


@pytest.mark.parametrize(
    ("name", "shown"),
    [("Zoë_1", "Zoe_1"), ("Zoe\u0308", "Zoe"), ("Łódź", "?odz"), ("写真 1", "?? 1"), ("a-1_2", "a-1_2")],
)
def test_contact_sheets_show_names_in_the_letters_that_their_font_has(name: str, shown: str) -> None:
    assert _in_ascii(name) == shown

"""Mirror orders checked in three independent ways: as permutations, by the drawn lines, and on names or real faces."""

import itertools

import numpy as np
import pytest

from jaxfit.data.pts import read_pts
from jaxfit.errors import InputError
from jaxfit.schemes.known import (
    AFLW21,
    IBUG68,
    LFPW27,
    LFPW27_NAMES,
    LFPW29,
    LFPW29_NAMES,
    SCHEMES,
    scheme_named,
    scheme_of_count,
)
from jaxfit.schemes.scheme import Scheme, mirrored

every_scheme = pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES)


@every_scheme
def test_mirroring_twice_changes_nothing(scheme):
    faces = np.random.default_rng(0).uniform(0, 100, (3, scheme.count, 2))
    np.testing.assert_allclose(mirrored(mirrored(faces, 160.0, scheme), 160.0, scheme), faces)
    assert sorted(scheme.mirror) == list(range(scheme.count))


@every_scheme
def test_a_point_stays_on_its_spot_of_the_flipped_picture(scheme):
    # Each landmark paints a pixel; flipping the picture moves the paint where the mirrored landmarks say.
    spots = np.random.default_rng(0).choice(40 * 30, scheme.count, replace=False)
    points = np.stack([spots % 40, spots // 40], 1)
    picture = np.full((30, 40), -1)
    picture[points[:, 1], points[:, 0]] = np.arange(scheme.count)
    x, y = mirrored(points, 40.0, scheme).T
    np.testing.assert_array_equal(picture[:, ::-1][y, x], scheme.mirror)


@every_scheme
def test_left_parts_become_right_parts(scheme):
    mirror = np.array(scheme.mirror)
    assert tuple(mirror[list(scheme.outer_eyes)]) == scheme.outer_eyes[::-1]
    left, right = scheme.pupils
    assert {*mirror[list(left)]} == {*right}


@every_scheme
def test_the_drawn_face_is_symmetric(scheme):
    edges = {frozenset(edge) for line in scheme.lines for edge in itertools.pairwise(line)}
    flipped = {frozenset(scheme.mirror[index] for index in edge) for edge in edges}
    assert flipped == edges


@every_scheme
def test_indices_are_in_range(scheme):
    used = [*scheme.outer_eyes, *itertools.chain(*scheme.pupils), *itertools.chain(*scheme.lines)]
    assert 0 <= min(used) <= max(used) < scheme.count


@pytest.mark.parametrize(("scheme", "names"), [(LFPW27, LFPW27_NAMES), (LFPW29, LFPW29_NAMES)])
def test_names_of_mirror_images_differ_in_the_side_only(scheme, names):
    swap = {"left": "right", "right": "left"}
    for index, name in enumerate(names):
        assert names[scheme.mirror[index]] == "_".join(swap.get(part, part) for part in name.split("_"))


def test_the_mean_of_real_faces_is_nearly_symmetric(shared_data):
    faces = np.stack([read_pts(path) for path in sorted((shared_data / "helen68").glob("*.pts"))[:100]])
    faces = faces - faces.mean(1, keepdims=True)
    mean = (faces / np.ptp(faces, 1).max(1)[:, None, None]).mean(0)
    assert np.abs(mirrored(mean, 1.0, IBUG68) - mean).max() < 0.04  # of the face's side
    assert mean[IBUG68.outer_eyes[0], 0] < -0.2
    assert mean[IBUG68.outer_eyes[1], 0] > 0.2


@every_scheme
def test_schemes_are_found_by_name(scheme):
    assert scheme_named(scheme.name) is scheme


def test_only_schemes_that_people_label_are_guessed_from_the_number_of_points():
    assert [scheme_of_count(count) for count in (21, 29, 68)] == [AFLW21, LFPW29, IBUG68]
    assert scheme_of_count(LFPW27.count) == Scheme("points27", 27)


def test_points_of_unknown_meaning():
    scheme = scheme_named("points12")
    assert scheme == scheme_of_count(12) == Scheme("points12", 12)
    with pytest.raises(InputError, match="points12 has no mirror order"):
        mirrored(np.zeros((12, 2)), 100.0, scheme)


@pytest.mark.parametrize(
    "name", ["", "ibug", "68", "points", "points0", "points-3", "points1.5", "points²", "points" + "9" * 5000]
)
def test_unknown_names_are_refused(name):
    with pytest.raises(InputError, match=r"known: aflw21, lfpw27, lfpw29, ibug68, points<N>"):
        scheme_named(name)

"""Conversions of landmarks: laws that need no pictures, and the mean faces of people labelled in both schemes."""

import numpy as np
import pytest
from jax import numpy as jnp

from jaxfit.errors import InputError
from jaxfit.labels.datasets import convert_dataset
from jaxfit.schemes.conversions import CONVERSIONS, convert, convertible, sources
from jaxfit.schemes.known import AFLW21, IBUG68, LFPW27, LFPW27_NAMES, LFPW29, LFPW29_NAMES, SCHEMES, scheme_named
from jaxfit.schemes.scheme import Scheme, mirrored
from jaxfit.shapes.procrustes import generalised_procrustes

every_conversion = pytest.mark.parametrize(
    ("source", "target"), [tuple(map(scheme_named, names)) for names in CONVERSIONS], ids=map("-".join, CONVERSIONS)
)


def random_faces(scheme: Scheme, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 100, (2, 3, scheme.count, 2))


@every_conversion
def test_every_point_is_the_mean_of_its_sources(source, target):
    faces = random_faces(source)
    converted = convert(faces, source, target)
    assert converted.shape == (2, 3, target.count, 2)
    for index, indices in enumerate(sources(source, target)):
        assert len({*indices}) == len(indices) > 0
        np.testing.assert_allclose(converted[1, 2, index], np.mean([faces[1, 2, i] for i in indices], 0))


@every_conversion
def test_depths_are_converted_as_the_other_coordinates(source, target):
    faces = random_faces(source)
    solid = np.concatenate([faces, faces[..., :1]], -1)
    converted = convert(solid, source, target)
    np.testing.assert_array_equal(converted[..., :2], convert(faces, source, target))
    np.testing.assert_array_equal(converted[..., 2], converted[..., 0])


@every_conversion
def test_mirroring_before_or_after_is_the_same(source, target):
    if source.mirror is None:
        pytest.skip(f"{source.name} does not say which points are mirror images")
    faces = random_faces(source)
    flipped = convert(mirrored(faces, 100.0, source), source, target)
    np.testing.assert_allclose(flipped, mirrored(convert(faces, source, target), 100.0, target))


@every_conversion
def test_eyes_stay_eyes(source, target):
    faces = random_faces(source)
    converted = convert(faces, source, target)
    np.testing.assert_allclose(converted[..., list(target.outer_eyes), :], faces[..., list(source.outer_eyes), :])
    for there, here in zip(target.pupils, source.pupils, strict=True):
        pupils = converted[..., list(there), :].mean(-2), faces[..., list(here), :].mean(-2)
        np.testing.assert_allclose(*pupils)


@every_conversion
def test_unknown_points_make_unknown_points_only_where_they_are_needed(source, target):
    face = random_faces(source)[0, 0]
    face[0] = np.nan
    unknown = np.isnan(convert(face, source, target)).all(1)
    np.testing.assert_array_equal(unknown, [0 in indices for indices in sources(source, target)])


def test_lfpw27_is_lfpw29_without_the_lower_brows():
    face = random_faces(LFPW29)[0, 0]
    by_name = dict(zip(LFPW29_NAMES, face, strict=True))
    assert {*LFPW29_NAMES} - {*LFPW27_NAMES} == {"left_eyebrow_center_bottom", "right_eyebrow_center_bottom"}
    np.testing.assert_array_equal(convert(face, LFPW29, LFPW27), [by_name[name] for name in LFPW27_NAMES])


@pytest.mark.parametrize("scheme", [*SCHEMES.values(), scheme_named("points5")], ids=lambda scheme: scheme.name)
def test_a_scheme_is_converted_to_itself_unchanged(scheme):
    faces = random_faces(scheme)
    np.testing.assert_array_equal(convert(faces, scheme, scheme), faces)


def test_impossible_conversions_are_refused_with_the_possible_ones():
    expected = "from aflw21 to ibug68; known conversions: ibug68 to aflw21, ibug68 to lfpw27, lfpw29 to lfpw27"
    with pytest.raises(InputError, match=expected):
        convert(random_faces(AFLW21), AFLW21, IBUG68)
    with pytest.raises(InputError, match="from points28 to lfpw27"):
        convert(np.zeros((28, 2)), scheme_named("points28"), LFPW27)
    assert convertible(scheme_named("points27"), LFPW27)  # if somebody says so


def test_landmarks_of_another_scheme_are_refused():
    for shape in ((21, 2), (21, 3), (68, 4), (68,)):
        with pytest.raises(InputError, match=r"\(\.\.\., 68, 2\) or \(\.\.\., 68, 3\); got \(" + str(shape[0])):
            convert(np.zeros(shape), IBUG68, AFLW21)


@pytest.mark.parametrize(
    ("target", "labelled"), [(AFLW21, "aflw:aflw"), (LFPW27, "lfpw:lfpw29/kbvt_lfpw_v1.csv")], ids=["aflw21", "lfpw27"]
)
def test_real_68_point_faces_become_faces_like_those_labelled_so(real_dataset, target, labelled):
    means = []
    for spec in (labelled, "pts:lfpw68"):
        dataset = convert_dataset(real_dataset(spec), target)
        faces = np.stack([face.landmarks for face in dataset.faces if face.complete])
        means.append(np.asarray(generalised_procrustes(jnp.asarray(faces, jnp.float32)).mean))
    truth, converted = means
    # Both means are centred, of the same size, and turned as faces are on average: upright.
    distances = np.linalg.norm(converted[:, None] - truth, axis=2)
    left, right = target.outer_eyes
    eyes = np.linalg.norm(truth[left] - truth[right])
    assert np.diag(distances).max() < 0.1 * eyes
    assert np.median(np.diag(distances)) < 0.04 * eyes
    # No point is nearer to the place of another.
    np.testing.assert_array_equal(distances.argmin(1), np.arange(target.count))

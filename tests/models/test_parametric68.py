"""The bundled ``parametric68`` on real pictures: any size, any rotation in the picture, and derivatives."""

from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfit
from jaxfit.cascade.fit import fit_starts
from jaxfit.cascade.state import features_of, state_of
from jaxfit.data.boxes import bounding_square
from jaxfit.data.crops import cut_face
from jaxfit.data.pictures import to_grey
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.shapes.space import Start

STARTS = jaxfit.Starts(11)


@pytest.fixture(scope="module")
def model() -> jaxfit.Model:
    return jaxfit.load("parametric68")


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    cbook = pytest.importorskip("matplotlib.cbook")
    return jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


@pytest.fixture(scope="module")
def upright(model: jaxfit.Model, portrait: np.ndarray) -> np.ndarray:
    (face,) = jaxfit.detect_faces(portrait)
    return jaxfit.fit(model, [portrait], [face.box], kind=face.kind).landmarks[0]


@pytest.fixture(scope="module")
def box(upright: np.ndarray) -> np.ndarray:
    """A square around the face, as models know it of every face: Haar's boxes are for upright ones."""
    return bounding_square(upright)


def apart(one: np.ndarray, other: np.ndarray, landmarks: np.ndarray) -> float:
    """Mean distance of two fits, as a share of the distance of the outer eye corners."""
    return float(np.linalg.norm(one - other, axis=1).mean() / np.linalg.norm(landmarks[36] - landmarks[45]))


def turned(picture: np.ndarray, box: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The picture turned about the box's centre, and the rotation and offset that points get."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[cos, -sin], [sin, cos]])
    centre = box[:2] + box[2:] / 2
    offset = centre - rotation @ centre
    size = picture.shape[1::-1]
    return cv2.warpAffine(picture, np.c_[rotation, offset], size, borderMode=cv2.BORDER_REPLICATE), rotation, offset


def test_agrees_with_sdm68(portrait, box, upright) -> None:
    sdm = jaxfit.fit(jaxfit.load("sdm68"), [portrait], [box]).landmarks[0]
    assert apart(sdm, upright, upright) < 0.06


@pytest.mark.parametrize("degrees", [-90, -65, -40, 0, 20, 50, 90])
def test_finds_the_face_in_a_turned_picture(model, portrait, box, upright, degrees) -> None:
    picture, rotation, offset = turned(portrait, box, degrees)
    found = jaxfit.fit(model, [picture], [box], starts=STARTS).landmarks[0]
    assert apart(found, upright @ rotation.T + offset, upright) < 0.06


def faces_of_sizes(portrait: np.ndarray, upright: np.ndarray, frame, factors: list[float]) -> list[np.ndarray]:
    """Crops of the portrait with its face at some sizes, relative to the canonical one, in the middle."""
    side = np.ptp(upright, 0).max()
    return [cut_face(to_grey(portrait), upright.mean(0), side / factor, frame).pixels for factor in factors]


def start_at(frame, factor: float) -> Start:
    return Start(jnp.full(2, frame.middle), jnp.float32(factor), jnp.float32(0.05))


@pytest.fixture(scope="module")
def seen(model) -> Callable:
    """The descriptors of a crop, with windows for a face of some size."""
    cascade = model.cascade
    window = jnp.float32(0.2 * cascade.frame.face)

    @jax.jit
    def seen(crop, factor):
        params = cascade.space.place(start_at(cascade.frame, 1.0)._replace(scale=factor))
        state = state_of(cascade.descriptor, cascade.space, params)
        states = jax.tree.map(lambda part: part[None, None], state)
        prepared = jax.vmap(cascade.descriptor.prepare)(crop[None])
        return features_of(cascade.descriptor, cascade.space, prepared, states, window)[0, 0]

    return seen


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.4, 2.0])
def test_a_face_of_another_size_has_the_same_descriptors(model, portrait, upright, seen, factor) -> None:
    # Thesis 3.2.2. The picture is first made coarse enough for all sizes, so that only sampling differs.
    cascade = model.cascade
    coarse = cv2.GaussianBlur(portrait, (0, 0), np.ptp(upright, 0).max() / 40)
    one, other = (
        np.asarray(seen(jnp.asarray(crop), jnp.float32(size)))
        for crop, size in zip(faces_of_sizes(coarse, upright, cascade.frame, [1.0, factor]), [1.0, factor], strict=True)
    )
    ones, others = (vector.reshape(68, -1) for vector in (one, other))
    similarity = (ones * others).sum(1) / np.linalg.norm(ones, axis=1) / np.linalg.norm(others, axis=1)
    # What remains at half the size: smoothing by 1.6 pixels is twice as wide on such a face.
    assert np.median(similarity) > 0.92
    # With a window that does not grow with the face they are not alike.
    fixed = np.asarray(seen(jnp.asarray(faces_of_sizes(coarse, upright, cascade.frame, [factor])[0]), jnp.float32(1.0)))
    unlike = (ones * fixed.reshape(68, -1)).sum(1) / np.linalg.norm(ones, axis=1)
    assert np.median(unlike) < np.median(similarity) - 0.1


@pytest.mark.parametrize(("factor", "bound"), [(0.5, 0.05), (0.7, 0.03), (1.3, 0.03)])
def test_a_face_of_another_size_is_fitted_alike(model, portrait, upright, factor, bound) -> None:
    frame = model.cascade.frame
    fit = jax.jit(fit_starts)
    fits = []
    for crop, size in zip(faces_of_sizes(portrait, upright, frame, [1.0, factor]), [1.0, factor], strict=True):
        start = jax.tree.map(lambda part: part[None], start_at(frame, size))
        fits.append((np.asarray(fit(model.cascade, jnp.asarray(crop)[None], start))[0, 0] - frame.middle) / size)
    assert apart(fits[1], fits[0], fits[0]) < bound


def test_the_whole_cascade_has_finite_derivatives_on_a_real_face(model, portrait, box, upright) -> None:
    crops, _ = jaxfit.crop_faces(model, [portrait], [box])
    cascade, crop = model.cascade, jnp.asarray(crops.pixels[0])
    truth = jnp.asarray(crops.from_images(upright[None])[0], jnp.float32)

    def loss(cascade, start: Start):
        fitted = fit_starts(cascade, crop[None], jax.tree.map(lambda part: part[None], start))[0, 0]
        return jnp.mean((fitted - truth) ** 2)

    start = Start(jnp.array([100.0, 108.0]), jnp.float32(1.1), jnp.float32(0.2))
    # Compiled without optimisation, which would take twice as long and changes nothing here.
    options = {"xla_backend_optimization_level": 0}
    by_cascade, by_start = jax.jit(jax.grad(loss, (0, 1)), compiler_options=options)(cascade, start)
    for name, derivative in by_start._asdict().items():
        assert np.isfinite(derivative).all(), name
        assert np.any(derivative != 0), name
    for derivative in jax.tree.leaves(by_cascade):
        assert np.isfinite(derivative).all()
    assert all(np.any(of_step != 0) for of_step in by_cascade.weights)


def test_turned_real_faces_are_as_good_as_upright_ones(model, real_dataset: Callable) -> None:
    # The model learned from these very faces: this guards the pipeline, it measures nothing.
    faces = real_dataset("pts:lfpw68").faces[::40]
    images = [jaxfit.read_image(face.image) for face in faces]
    boxes = start_boxes(faces)
    truth = np.stack([face.landmarks for face in faces])
    sizes = np.linalg.norm(truth[:, 36] - truth[:, 45], axis=1)
    medians = []
    for degrees in (0, 70):
        views = [turned(image, box, degrees) for image, box in zip(images, boxes, strict=True)]
        fits = jaxfit.fit(model, [picture for picture, _, _ in views], boxes, starts=STARTS).landmarks
        moved = np.stack([points @ turn.T + offset for points, (_, turn, offset) in zip(truth, views, strict=True)])
        medians.append(np.median(np.linalg.norm(fits - moved, axis=2).mean(1) / sizes))
    assert medians[0] < 0.06
    assert medians[1] < 1.25 * medians[0]

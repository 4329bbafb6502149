"""Where fits start: rotations over a range, what is no range, and turned faces in the square of the upright one."""

import jax
import numpy as np
import pytest
from blobs import FRAME, SPACE
from jax import numpy as jnp

from jaxfit.cascade.starts import Spread, Starts, square_around, starts_of
from jaxfit.errors import InputError
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.similarity import SimilarityASM
from jaxfit.shapes.space import ShapeSpace

# A mean face whose bounding square does not lie around its centroid.
LOPSIDED = SimilarityASM(
    ActiveShapeModel(
        jnp.array([[-12.0, -9.0], [10.0, -12.0], [-3.0, 12.0]]), jnp.zeros((1, 3, 2)).at[0, 1, 1].set(1.0), jnp.ones(1)
    ),
    jnp.float32(3.0),
)


@pytest.mark.parametrize(
    ("starts", "degrees"),
    [
        (Starts(), [0]),
        (Starts(1, -80.0, 90.0), [5]),
        (Starts(1, 30.0, 30.0), [30]),
        (Starts(3), [-90, 0, 90]),
        (Starts(4, -80.0, 90.0), [-80, -80 + 170 / 3, -80 + 340 / 3, 90]),
        (Starts(5, -80.0, 90.0), [-80, -37.5, 5, 47.5, 90]),
        (Starts(3, 20.0, 20.0), [20, 20, 20]),
        # Of a full circle both ends are the same.
        (Starts(4, -180.0, 180.0), [-180, -90, 0, 90]),
        (Starts(3, 0.0, 360.0), [0, 120, 240]),
        (Starts(1, -180.0, 180.0), [0]),
    ],
    ids=str,
)
def test_rotations_cover_the_range_evenly(starts: Starts, degrees: list[float]) -> None:
    assert starts.rotations.dtype == jnp.float32
    np.testing.assert_allclose(starts.rotations, np.radians(degrees), atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        (0, -90.0, 90.0),
        (-3, -90.0, 90.0),
        (2, -90.0, 90.0),
        (3, -180.0, 200.0),
        (3, 90.0, -90.0),
        (3, float("nan"), 90.0),
        (3, -90.0, float("nan")),
        (3, -900.0, 90.0),
        (3, 300.0, 400.0),
        (1, 90.0, -90.0),
    ],
    ids=str,
)
def test_impossible_starts_are_refused(wrong: tuple[int, float, float]) -> None:
    words = "expected rotations of starts in degrees" if wrong[0] in (1, 3) else "expected one start or at least three"
    with pytest.raises(InputError, match=words):
        Starts(*wrong)


@pytest.mark.parametrize(
    ("starts", "turn"),
    [
        (Starts(), 0),
        (Starts(1, -180.0, 180.0), 0),
        (Starts(3), 0.7 * np.pi),
        (Starts(11, -10.0, 30.0), 0.7 * np.radians(40)),
        (Starts(3, 20.0, 20.0), 0),
        (Starts(7, -180.0, 180.0), np.pi),
    ],
    ids=str,
)
def test_training_turns_by_a_share_of_the_range_and_never_by_more_than_half_a_turn(starts: Starts, turn: float) -> None:
    assert starts.turn == pytest.approx(turn)


def test_starts_are_static_arguments_of_jitted_functions() -> None:
    traced = []

    @jax.jit
    def rotations(starts: Starts) -> jax.Array:
        traced.append(starts)
        return starts.rotations

    assert jax.tree.leaves(Starts(3)) == []
    for starts in (Starts(3), Starts(3), Starts(3, -90.0, 90.0), Starts(5)):
        np.testing.assert_array_equal(rotations(starts), starts.rotations)
    assert traced == [Starts(3), Starts(5)]
    assert len({Starts(3), Starts(3, -90.0, 90.0), Starts(5)}) == 2


@pytest.mark.parametrize("space", [SPACE, LOPSIDED], ids=["points", "asm"])
def test_turned_starts_have_the_bounding_square_of_the_upright_one(space: ShapeSpace) -> None:
    rotations = [0.0, -0.8, -0.3, 0.3, 0.8, np.pi / 2]
    starts = starts_of(space, FRAME, jnp.asarray(rotations))
    faces = np.asarray(jax.vmap(lambda start: space.landmarks(space.place(start)))(starts))
    middles = (faces.min(1) + faces.max(1)) / 2
    np.testing.assert_allclose(middles, np.broadcast_to(middles[0], middles.shape), atol=1e-3)
    sides = np.ptp(faces, 1).max(1)
    np.testing.assert_allclose(sides, sides[0], rtol=1e-4)
    np.testing.assert_allclose(starts.rotation, rotations)
    np.testing.assert_allclose([*starts.centre[0], starts.scale[0]], [23.5, 23.5, 1], rtol=1e-6)


def test_the_square_around_points() -> None:
    middle, side = square_around(jnp.array([[1.0, 2.0], [5.0, 3.0], [2.0, 4.0]]))
    assert (*middle.tolist(), float(side)) == (3, 3, 4)


def test_a_scaled_spread_is_scaled_in_all_its_parts() -> None:
    spread = Spread((0.1, 0.2), 0.3, 0.4)
    np.testing.assert_allclose(spread.sigmas, [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(spread.scaled(3.0).sigmas, 3 * spread.sigmas)

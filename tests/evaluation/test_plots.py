"""Figures show what they were given, curves, modes, descriptors, surfaces, and say what to install when they cannot."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type,attr-defined,operator,union-attr"

import sys
from collections.abc import Callable, Iterator
from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy import ndimage

from jaxfit.descriptors.descriptor import describe_point
from jaxfit.descriptors.sift import Sift, principal_orientation, upright_window
from jaxfit.errors import InputError
from jaxfit.evaluation.curves import ced
from jaxfit.evaluation.plots import plot_ced, plot_descriptor, plot_modes, plot_pose_surface
from jaxfit.evaluation.pose import PoseGrid
from jaxfit.schemes.known import IBUG68
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.asm import ActiveShapeModel

ERRORS = {"SDM": np.array([0.02, 0.04, np.inf]), "parametric": np.array([0.01, 0.03, np.nan])}


@pytest.fixture
def pyplot() -> Iterator:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    yield plt
    plt.close("all")


def test_curves_labels_and_legend(pyplot) -> None:
    axes = plot_ced(ERRORS, limit=0.05, error="NMED (3D)")
    assert axes.get_xlabel() == "NMED (3D)"
    assert axes.get_ylabel()
    assert axes.get_xlim() == (0.0, 0.05)
    for line, errors in zip(axes.get_lines(), ERRORS.values(), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), ced(errors, np.asarray(line.get_xdata())))
    entries = [text.get_text() for text in axes.get_legend().get_texts()]
    assert entries == ["SDM (AUC@0.05 0.267)", "parametric (AUC@0.05 0.600)"]
    axes.figure.canvas.draw()


def test_draws_on_given_axes(pyplot) -> None:
    axes = pyplot.subplots()[1]
    assert plot_ced(ERRORS, ax=axes) is axes


def test_methods_of_one_name_and_score_are_kept_apart_by_name(pyplot) -> None:
    same = np.array([0.01])
    assert len(plot_ced({"a": same, "b": same}).get_lines()) == 2


def test_nothing_to_plot(pyplot) -> None:
    assert plot_ced({}).get_legend() is None


SIGMAS = (-2.0, 1.5)
SQUARE = Scheme("square", 4, lines=((0, 1, 2, 3, 0), (0, 2)))


def shape_model(dimensions: int = 2) -> ActiveShapeModel:
    """Four landmarks and three modes, whose variances are 9 : 4 : 1."""
    rng = np.random.default_rng(0)
    modes = np.linalg.qr(rng.normal(size=(4 * dimensions, 3)))[0].T.reshape(3, 4, dimensions)
    mean = 10 * rng.normal(size=(4, dimensions))
    return ActiveShapeModel(*(jnp.asarray(part, jnp.float32) for part in (mean, modes, [3.0, 2.0, 1.0])))


@pytest.mark.parametrize("dimensions", [2, 3])
def test_modes_over_the_mean(pyplot, dimensions: int) -> None:
    model = shape_model(dimensions)
    axes = plot_modes(model, SQUARE, modes=2, sigmas=SIGMAS)
    assert axes.shape == (2, 2)
    for (mode, column), ax in np.ndenumerate(axes):
        b = np.zeros(3, np.float32)
        b[mode] = SIGMAS[column] * model.deviations[mode]
        drawn = [np.array(line.get_data()).T for line in ax.get_lines()]
        # Every face is the scheme's lines, then all points; the mean lies beneath.
        for face, (*lines, points) in ((model.mean, drawn[:3]), (model.reconstruct(jnp.asarray(b)), drawn[3:])):
            expected = np.asarray(face)[:, :2]
            np.testing.assert_allclose(points, expected, atol=1e-5)
            for line, indices in zip(lines, SQUARE.lines, strict=True):
                np.testing.assert_allclose(line, expected[list(indices)], atol=1e-5)
        bottom, top = ax.get_ylim()
        assert bottom > max(points[:, 1].max() for points in drawn)
        assert top < min(points[:, 1].min() for points in drawn)
        assert ax.get_aspect() == 1
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in axes.flat}) == 1
    axes[0, 0].figure.canvas.draw()


def test_modes_are_labelled(pyplot) -> None:
    axes = plot_modes(shape_model(), SQUARE, sigmas=SIGMAS)
    assert [ax.get_title() for ax in axes[0]] == ["−2 σ", "+1.5 σ"]
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["mode 1 (64%)", "mode 2 (29%)", "mode 3 (7%)"]


def test_modes_of_a_scheme_without_lines(pyplot) -> None:
    axes = plot_modes(shape_model(), Scheme("points4", 4), modes=1, sigmas=[3.0])
    assert [len(line.get_xdata()) for line in axes[0, 0].get_lines()] == [4, 4]


def test_modes_on_given_axes(pyplot) -> None:
    axes = pyplot.subplots(2, 4)[1]
    assert plot_modes(shape_model(), SQUARE, modes=2, axes=axes) is axes
    with pytest.raises(InputError, match=r"\(3, 4\) of axes.*\(2, 4\)"):
        plot_modes(shape_model(), SQUARE, axes=axes)


def test_modes_that_cannot_be_drawn() -> None:
    for modes in (0, 4):
        with pytest.raises(InputError, match=f"has 3 modes; expected 1 to 3 of them to draw, got {modes}"):
            plot_modes(shape_model(), SQUARE, modes=modes)
    with pytest.raises(InputError, match="has 4 landmarks; scheme ibug68 has 68"):
        plot_modes(shape_model(), IBUG68)
    with pytest.raises(InputError, match="at least one value"):
        plot_modes(shape_model(), SQUARE, sigmas=())


POINT, SIDE, ANGLE = np.array([30.0, 34.0]), 24.0, 0.4


@pytest.fixture(scope="module")
def crop() -> np.ndarray:
    noise = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(64, 72)), 3)
    return np.interp(noise, (noise.min(), noise.max()), (0, 255)).astype(np.uint8)


@jax.jit
def principal_angle(crop: jax.Array) -> jax.Array:
    smoothed = Sift().prepare(crop).smoothed
    return principal_orientation(upright_window(smoothed, jnp.float32(POINT), jnp.float32(SIDE / 32)))


@partial(jax.jit, static_argnums=0)
def described(sift: Sift, crop: jax.Array) -> jax.Array:
    return describe_point(sift, sift.prepare(crop), jnp.float32(POINT), jnp.float32(SIDE), jnp.float32(ANGLE))


def window_angle(orientation: str, crop: np.ndarray) -> float:
    if orientation == "principal":
        return float(principal_angle(crop))
    return {"upright": 0.0, "face": ANGLE}[orientation]


@pytest.mark.parametrize(
    ("orientation", "normalisation"), [("upright", "vector"), ("face", "cell"), ("principal", "vector")]
)
def test_descriptor(pyplot, crop: np.ndarray, orientation: str, normalisation: str) -> None:
    sift = Sift(orientation, normalisation)
    ax = plot_descriptor(sift, crop, POINT, SIDE, ANGLE)
    np.testing.assert_array_equal(ax.get_images()[0].get_array(), crop)
    turned = np.exp(1j * window_angle(orientation, crop))  # x + iy, y down: turns clockwise as seen
    centre = complex(*POINT)

    # Cells: lines at quarters of the window, from edge to edge, turned about the landmark.
    quarters = SIDE * (np.arange(5) / 4 - 0.5)
    half = SIDE / 2
    upright = [line for q in quarters for line in ((q - 1j * half, q + 1j * half), (-half + 1j * q, half + 1j * q))]
    drawn = [complex(*end) for line in ax.get_lines()[:10] for end in np.transpose(line.get_data())]
    np.testing.assert_allclose(drawn, centre + turned * np.ravel(upright), atol=1e-3)

    # Arrows: eight from the middle of each cell, rows first; as long as the descriptor says, in the bins' directions.
    (arrows,) = (thing for thing in ax.collections if hasattr(thing, "U"))
    tails = arrows.get_offsets() @ [1, 1j]
    middles = quarters[:-1] + SIDE / 8
    cells = np.repeat([x + 1j * y for y in middles for x in middles], 8)
    np.testing.assert_allclose(tails, centre + turned * cells, atol=1e-3)
    values = np.asarray(described(sift, crop))
    bins = np.exp(1j * np.radians(22.5 + 45 * np.arange(8)))
    expected = values / values.max() * SIDE / 8 * np.tile(bins, 16) * turned
    np.testing.assert_allclose(arrows.U + 1j * arrows.V, expected, atol=1e-3)
    # In units of the axes, so that lengths are those of the picture.
    assert (arrows.angles, arrows.scale_units, arrows.scale) == ("xy", "xy", 1.0)
    ax.figure.canvas.draw()


def test_arrows_point_to_the_bright(pyplot) -> None:
    rising = np.tile(np.arange(64, dtype=np.uint8) * 3, (64, 1)).T  # brighter towards the bottom
    ax = plot_descriptor(Sift(), rising, (32.0, 32.0), 20.0)
    (arrows,) = (thing for thing in ax.collections if hasattr(thing, "U"))
    assert arrows.V.max() > 0
    assert arrows.V.min() > -1e-6
    assert ax.get_ylim()[0] > ax.get_ylim()[1]  # y is down


def test_a_flat_window_has_no_arrows(pyplot) -> None:
    ax = pyplot.subplots()[1]
    assert plot_descriptor(Sift("principal"), np.full((64, 64), 90, np.uint8), (32.0, 32.0), 20.0, ax=ax) is ax
    (arrows,) = (thing for thing in ax.collections if hasattr(thing, "U"))
    assert not np.hypot(arrows.U, arrows.V).any()
    ax.figure.canvas.draw()


def test_descriptors_that_cannot_be_drawn(crop: np.ndarray) -> None:
    for wrong in (crop[..., None], crop.astype(np.float32)):
        with pytest.raises(InputError, match="expected a grey crop"):
            plot_descriptor(Sift(), wrong, POINT, SIDE)
    for point, side, angle in (
        ((1.0,), SIDE, 0.0),
        ((np.nan, 1.0), SIDE, 0.0),
        (POINT, 0.0, 0.0),
        (POINT, 9.0, np.inf),
    ):
        with pytest.raises(InputError, match="expected a finite point"):
            plot_descriptor(Sift(), crop, point, side, angle)


def pose_grid_of(mean: np.ndarray) -> PoseGrid:
    """A grid by 15 degrees from -30 up; NaN are cells without faces."""
    pitches, yaws = (15.0 * np.arange(size) - 30 for size in mean.shape)
    count = np.isfinite(mean).astype(int)
    return PoseGrid(pitches, yaws, mean, count, 1 - count)


POSE_GRID = pose_grid_of(np.array([[np.nan, 9.0, np.nan, np.nan], [1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, np.nan]]))


def test_pose_surface(pyplot) -> None:
    ax = plot_pose_surface(POSE_GRID, title="yaw")
    surface, dots = ax.collections
    # A dot for every cell with faces, at (yaw, pitch, error).
    drawn = np.ma.getdata(np.stack(dots._offsets3d, axis=1))
    expected = [(15.0 * j - 30, 15.0 * i - 30, e) for (i, j), e in np.ndenumerate(POSE_GRID.mean) if np.isfinite(e)]
    np.testing.assert_allclose(sorted(drawn.tolist()), sorted(expected))
    # Between four cells a patch, as bright as the mean of those with faces; rows of patches from the lowest pitch.
    brightness = [
        (9 + 1 + 2) / 3,
        (9 + 2 + 3) / 3,
        (3 + 4) / 2,
        (1 + 2 + 5 + 6) / 4,
        (2 + 3 + 6 + 7) / 4,
        (3 + 4 + 7) / 3,
    ]
    np.testing.assert_allclose(surface.get_array(), brightness)
    assert surface.get_clim() == ax.get_zlim() == (0.0, 9.0)
    assert (ax.get_title(), ax.get_xlabel()[:8], ax.get_ylabel()[:10]) == ("yaw", "true yaw", "true pitch")
    ax.figure.canvas.draw()


@pytest.mark.parametrize(
    "mean",
    [
        np.zeros((3, 3)),
        np.array([[4.0]]),
        np.array([[1.0, np.nan, 2.0]]),
        np.array([[1.0, np.nan], [np.nan, 2.0]]),
        np.ones((60, 70)),
    ],
    ids=["perfect", "one cell", "one pitch", "apart", "large"],
)
def test_pose_surfaces_of_odd_grids(pyplot, mean: np.ndarray) -> None:
    ax = pyplot.subplots(subplot_kw={"projection": "3d"})[1]
    assert plot_pose_surface(pose_grid_of(mean), ax) is ax
    assert len(ax.collections[1].get_offsets()) == np.isfinite(mean).sum()
    assert ax.get_zlim()[1] > 0
    ax.figure.canvas.draw()


def test_pose_surfaces_that_cannot_be_drawn(pyplot) -> None:
    for nothing in (np.full((2, 2), np.nan), np.empty((0, 0))):
        with pytest.raises(InputError, match="nothing to draw"):
            plot_pose_surface(pose_grid_of(nothing))
    with pytest.raises(InputError, match='projection="3d"; got rectilinear'):
        plot_pose_surface(POSE_GRID, pyplot.subplots()[1])


@pytest.mark.parametrize(
    "plot",
    [
        lambda crop: plot_ced(ERRORS),
        lambda crop: plot_modes(shape_model(), SQUARE),
        lambda crop: plot_descriptor(Sift(), crop, POINT, SIDE),
        lambda crop: plot_pose_surface(POSE_GRID),
    ],
    ids=["ced", "modes", "descriptor", "pose surface"],
)
def test_without_matplotlib(plot: Callable, crop: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(InputError, match=r'pip install "jaxfit\[plots\]"'):
        plot(crop)

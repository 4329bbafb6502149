"""Figures of errors, pose errors, shape models and descriptors; needs matplotlib, the optional extra ``plots``."""

import math
from collections.abc import Sequence
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jax import numpy as jnp

from jaxfit.descriptors.descriptor import describe_point
from jaxfit.descriptors.sift import BINS, CELLS, Sift
from jaxfit.errors import InputError
from jaxfit.evaluation.calibration import Reliability
from jaxfit.evaluation.curves import LIMIT, auc, ced
from jaxfit.evaluation.pose import YAW_MIDDLES, PoseGrid, medians_by_yaw
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.space import rotate
from jaxfit.types import Crop, Features, Point, Scalar

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

_MARGIN = 0.08  # around drawn faces, as a share of their size
_SURROUNDINGS = 0.8  # how far a descriptor's figure reaches from the landmark, in sides of the window


def plot_ced(
    errors_by_name: dict[str, np.ndarray],
    limit: float = LIMIT,
    ax: "matplotlib.axes.Axes | None" = None,
    error: str = "NMED",
) -> "matplotlib.axes.Axes":
    """CED curves from 0 to ``limit``, with the area under each, up to there, in the legend.

    Args:
        errors_by_name: (N,) normalised errors of each method; ``inf`` is a failed fit, NaN is left out.
        limit: where the curves end, in the units of the errors.
        ax: where to draw; a new figure if None.
        error: what is measured.

    Returns:
        The axes drawn on.

    Raises:
        InputError: matplotlib is missing, errors are not a vector, or the limit is not positive.
    """
    thresholds = np.linspace(0.0, limit, 501)
    curves = {
        f"{name} (AUC@{limit:g} {auc(errors, limit):.3f})": ced(errors, thresholds)
        for name, errors in errors_by_name.items()
    }
    ax = ax if ax is not None else pyplot().subplots()[1]
    for label, shares in curves.items():
        ax.plot(thresholds, shares, label=label)
    ax.set(xlim=(0.0, limit), ylim=(0.0, 1.0), xlabel=error, ylabel="share of faces")
    ax.grid(alpha=0.3)
    if curves:
        ax.legend(loc="lower right")
    return ax


def plot_by_yaw(
    errors_by_name: dict[str, np.ndarray],
    yaws: np.ndarray,
    ax: "matplotlib.axes.Axes | None" = None,
    error: str = "NMED",
) -> "matplotlib.axes.Axes":
    """Median errors over true yaw, of 15 degrees each; where most faces have no fit, the curve has a gap.

    Args:
        errors_by_name: (N,) errors of each method; ``inf`` is a failed fit, NaN is left out.
        yaws: (N,) true yaws in degrees, NaN where unknown.
        ax: where to draw; a new figure if None.
        error: what is measured.

    Returns:
        The axes drawn on.

    Raises:
        InputError: matplotlib is missing.
    """
    ax = ax if ax is not None else pyplot().subplots()[1]
    for name, errors in errors_by_name.items():
        medians = medians_by_yaw(errors, yaws)
        ax.plot(YAW_MIDDLES, np.where(np.isinf(medians), np.nan, medians), ".-", label=name)
    ax.set(xlabel="true yaw, degrees", ylabel=f"median {error}", xticks=YAW_MIDDLES[::2])
    ax.set_ylim(bottom=0.0)
    ax.grid(alpha=0.3)
    if errors_by_name:
        ax.legend()
    return ax


def plot_reliability(
    reliability_by_name: dict[str, Reliability], ax: "matplotlib.axes.Axes | None" = None
) -> "matplotlib.axes.Axes":
    """Reliability diagram: how often predictions of some probability came true; on the diagonal, as often as predicted.

    Args:
        reliability_by_name: from ``evaluation.calibration.reliability``; the legend has the calibration error of each.
        ax: where to draw; a new figure if None.

    Returns:
        The axes drawn on.

    Raises:
        InputError: matplotlib is missing.
    """
    ax = ax if ax is not None else pyplot().subplots()[1]
    ax.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for name, each in reliability_by_name.items():
        (line,) = ax.plot(each.predicted, each.observed, label=f"{name} (ECE {each.error:.3f})")
        sizes = 200 * each.counts / max(each.counts.max(), 1)
        ax.scatter(each.predicted, each.observed, s=sizes, color=line.get_color(), alpha=0.5)
    ax.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), aspect="equal", xlabel="predicted", ylabel="observed")
    ax.grid(alpha=0.3)
    if reliability_by_name:
        ax.legend(loc="upper left")
    return ax


def plot_modes(
    model: ActiveShapeModel,
    scheme: Scheme,
    modes: int = 3,
    sigmas: Sequence[float] = (-2.0, -1.0, 1.0, 2.0),
    axes: np.ndarray | None = None,
) -> np.ndarray:
    """What the first modes of a shape model do to its mean face (thesis, Figure 6).

    Row i, column k show the face whose only coefficient is bᵢ = ``sigmas[k]`` · σᵢ, over the mean in grey. A row is
    labelled with the mode's share of the variance that the model holds. 3D faces are drawn by their x and y.

    Args:
        model: the shape model, of L landmarks.
        scheme: says which points lines join.
        modes: how many modes to draw, the one with most variance first.
        sigmas: values of the coefficient, in standard deviations; one column each.
        axes: (modes, len(sigmas)) matplotlib axes to draw on; a new figure if None.

    Returns:
        (modes, len(sigmas)) the axes drawn on.

    Raises:
        InputError: matplotlib is missing, the model has fewer modes or not the scheme's landmarks, or there are not
            as many axes.
    """
    held = len(model.deviations)
    if not 1 <= modes <= held:
        raise InputError(f"the shape model has {held} modes; expected 1 to {held} of them to draw, got {modes}")
    if len(model.mean) != scheme.count:
        raise InputError(
            f"the shape model has {len(model.mean)} landmarks; scheme {scheme.name} has {scheme.count}: they must agree"
        )
    if not len(sigmas):
        raise InputError("expected at least one value of the coefficients, in standard deviations; got none")
    grid = (modes, len(sigmas))
    if axes is None:
        axes = pyplot().subplots(*grid, squeeze=False, figsize=(2.0 * grid[1], 1.8 * grid[0]), layout="constrained")[1]
    elif axes.shape != grid:
        raise InputError(f"expected an array {grid} of axes, a row a mode and a column a sigma; got {axes.shape}")

    mean = np.asarray(model.mean)[:, :2]
    coefficients = jnp.diag(model.deviations)[:modes, None, :] * jnp.asarray(sigmas)[None, :, None]
    faces = np.asarray(jax.vmap(jax.vmap(model.reconstruct))(coefficients))[..., :2]
    shares = np.asarray(model.deviations) ** 2 / np.sum(np.asarray(model.deviations) ** 2)
    # All in one frame, so that faces can be compared; y is down.
    everything = np.concatenate([faces.reshape(-1, 2), mean])
    margin = _MARGIN * np.ptp(everything, 0).max()
    (left, top), (right, bottom) = everything.min(0) - margin, everything.max(0) + margin
    for (row, column), ax in np.ndenumerate(axes):
        draw_face(ax, mean, scheme, "0.8")
        draw_face(ax, faces[row, column], scheme, "C0")
        ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[], frame_on=False)
        if row == 0:
            ax.set_title(f"{sigmas[column]:+g} σ".replace("-", "−"))
        if column == 0:
            ax.set_ylabel(f"mode {row + 1} ({shares[row]:.0%})")
    return axes


def draw_face(ax: "matplotlib.axes.Axes", points: np.ndarray, scheme: Scheme, colour: str) -> None:
    """Draw landmarks (L, 2) and the lines between them; what is NaN is left out."""
    for line in scheme.lines:
        ax.plot(*points[list(line)].T, color=colour, linewidth=1.2)
    ax.plot(*points.T, ".", color=colour, markersize=3)


def plot_descriptor(
    sift: Sift,
    crop: np.ndarray,
    point: np.ndarray | jax.Array | Sequence[float],
    side: float,
    angle: float = 0.0,
    ax: "matplotlib.axes.Axes | None" = None,
) -> "matplotlib.axes.Axes":
    """What a descriptor holds, over the picture it is taken from (thesis, Figure 3).

    Around the landmark are the window's 4 × 4 cells, turned as the descriptor turns them; a tick outside the window
    shows where its x axis points. In each cell an arrow for each of the 8 orientations of the gradient, which points
    from dark to bright; its length is the descriptor's value, the largest reaching half across a cell.

    Args:
        sift: the descriptor.
        crop: (H, W) uint8, grey.
        point: (2,) the landmark, x right, y down, in crop pixels.
        side: of the window, in crop pixels.
        angle: rotation of the face, in radians, clockwise as seen; matters to descriptors that turn with the face.
        ax: where to draw; a new figure if None.

    Returns:
        The axes drawn on, which show the window and what lies around it.

    Raises:
        InputError: matplotlib is missing, the crop is not grey, a number is not finite, or the side is not positive.
    """
    crop, centre = np.asarray(crop), np.asarray(point, np.float32)
    if crop.ndim != 2 or crop.dtype != np.uint8:
        raise InputError(f"expected a grey crop, uint8 (H, W); got {crop.dtype} {crop.shape}")
    if not (centre.shape == (2,) and np.isfinite([*centre, side, angle]).all() and side > 0):
        raise InputError(
            f"expected a finite point (x, y), a side > 0 and a finite angle; got {centre}, {side} and {angle}"
        )
    ax = ax if ax is not None else pyplot().subplots()[1]
    landmark, face_angle = jnp.asarray(centre), jnp.float32(angle)
    values, turn = _described(sift, jnp.asarray(crop), landmark, jnp.float32(side), face_angle)

    def in_crop(offsets: np.ndarray) -> np.ndarray:
        """Offsets (..., 2) from the landmark along the window's axes, in sides, as crop points."""
        return centre + side * np.asarray(rotate(jnp.asarray(offsets, jnp.float32), turn))

    ax.imshow(crop, cmap="gray", vmin=0, vmax=255)
    edges = np.arange(CELLS + 1) / CELLS - 0.5
    for edge in edges:
        for ends in ([(edge, -0.5), (edge, 0.5)], [(-0.5, edge), (0.5, edge)]):
            ax.plot(*in_crop(np.array(ends)).T, color="yellow", linewidth=0.8, alpha=0.7)
    ax.plot(*in_crop(np.array([(0.5, 0.0), (0.6, 0.0)])).T, color="yellow", linewidth=2.0)
    middles = (edges[:-1] + edges[1:]) / 2
    tails = in_crop(np.stack(np.meshgrid(middles, middles), -1).reshape(-1, 2))
    directions = 2 * math.pi * (np.arange(BINS) + 0.5) / BINS + float(turn)  # the middles of the bins
    longest = float(values.max()) or 1.0  # a flat window has no arrows
    lengths = np.asarray(values).reshape(CELLS**2, BINS) / longest * side / CELLS / 2
    ax.quiver(
        *(tails.T[:, :, None] * np.ones(BINS)),
        lengths * np.cos(directions),
        lengths * np.sin(directions),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        units="xy",
        width=side / 150,
        minlength=0.0,
        color="cyan",
    )
    ax.plot(*centre, "+", color="red")
    reach = _SURROUNDINGS * side
    ax.set(
        xlim=(centre[0] - reach, centre[0] + reach),
        ylim=(centre[1] + reach, centre[1] - reach),
        xlabel="x [crop pixels]",
        ylabel="y [crop pixels]",
    )
    return ax


@partial(jax.jit, static_argnames="sift")
def _described(sift: Sift, crop: Crop, point: Point, side: Scalar, angle: Scalar) -> tuple[Features, Scalar]:
    """The descriptor, and how far its window is turned."""
    prepared = sift.prepare(crop)
    return describe_point(sift, prepared, point, side, angle), sift.window_angle(prepared, point, side, angle)


def plot_pose_surface(
    grid: PoseGrid, ax: "matplotlib.axes.Axes | None" = None, title: str = ""
) -> "matplotlib.axes.Axes":
    """Mean absolute error of one angle as a surface over true pitch and yaw (thesis, Figures 20 and 21).

    Height and colour are the error. The surface spans cells whose neighbours have faces too; dots mark every cell
    with faces, so that poses on their own are seen as well.

    Args:
        grid: of the angle.
        ax: three-dimensional axes to draw on; a new figure if None.
        title: of the axes.

    Returns:
        The axes drawn on.

    Raises:
        InputError: matplotlib is missing, the axes are not three-dimensional, or no cell of the grid has faces.
    """
    known = np.isfinite(grid.mean)
    if not known.any():
        raise InputError("the pose grid has no face that was found and whose pose is known: there is nothing to draw")
    if ax is not None and ax.name != "3d":
        raise InputError(f'expected axes made with projection="3d"; got {ax.name} axes')
    solid: Any = ax if ax is not None else pyplot().subplots(subplot_kw={"projection": "3d"})[1]
    yaw, pitch = np.meshgrid(grid.yaws, grid.pitches)
    highest = float(grid.mean[known].max()) or 1.0  # all errors may be zero
    # Strides of 1: by default large grids are thinned.
    net = {"rstride": 1, "cstride": 1, "edgecolor": "0.3", "linewidth": 0.3}
    solid.plot_surface(yaw, pitch, grid.mean, cmap="viridis", vmin=0.0, vmax=highest, **net)
    solid.scatter(yaw[known], pitch[known], grid.mean[known], color="black", s=2)
    solid.set(xlabel="true yaw [°]", ylabel="true pitch [°]", zlabel="mean absolute error [°]", zlim=(0.0, highest))
    solid.set_title(title)
    solid.view_init(elev=40.0, azim=-60.0)  # high enough to look into the valley of frontal poses
    for axis in ("x", "y"):
        solid.locator_params(axis, nbins=7, steps=[1, 1.5, 3, 6, 10])  # angles read best by 15, 30 or 60
    return solid


def new_figure(width: float, height: float) -> "matplotlib.figure.Figure":
    """An empty figure of a size in inches, which pyplot does not know and which need not be closed.

    Raises:
        InputError: matplotlib is missing.
    """
    pyplot()
    from matplotlib.figure import Figure

    return Figure((width, height), layout="constrained")


def pyplot() -> ModuleType:
    """Matplotlib's pyplot, imported only where something is drawn.

    Raises:
        InputError: it is missing.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise InputError('plots need matplotlib: pip install "jaxfit[plots]"') from error
    return plt

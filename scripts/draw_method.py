"""Draw the pictures of docs/method.md: a cascade at work on matplotlib's portrait, its shape models, a descriptor."""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.cbook
import matplotlib.pyplot as plt
import numpy as np
from report import save_figure

import jaxfit
from jaxfit.cascade import first_steps, fit_crops
from jaxfit.cascade.starts import starts_of
from jaxfit.evaluation.plots import plot_descriptor, plot_modes
from jaxfit.heads import load_head_model
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import pose_rotation
from jaxfit.shapes.space import rotate

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "method"
MODEL = "parametric68"
SHOWN = (0, 1, 2, 7)  # steps taken, of seven
WITH_WINDOWS = (36, 8, 54)  # an eye's corner, the chin, the mouth's corner
CORNER = 36
YAWS = (60, 30, 0, -30, -60)


def main() -> int:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    FOLDER.mkdir(exist_ok=True)
    model = jaxfit.load(MODEL)
    image = jaxfit.read_image(matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))
    face = jaxfit.detect_faces(image)[0]
    off = face.box + face.box[2] * np.array([0.12, -0.1, 0.15, 0.15])  # so that there is something to do
    crops, _ = jaxfit.crop_faces(model, [image], [off], kind=face.kind)
    counts = range(1, len(model.cascade.windows) + 1)
    after = [fit_crops(first_steps(model.cascade, count), jnp.asarray(crops.pixels)) for count in counts]
    space: Any = model.cascade.space  # an Active Shape Model's
    start = jax.tree.map(lambda part: part[0], starts_of(space, model.cascade.frame, jnp.zeros(1)))
    path = jnp.concatenate([space.landmarks(space.place(start))[None], *after])
    draw_steps(model, crops.pixels[0], path)
    draw_descriptors(model, crops.pixels[0], path[-1])
    plot_modes(space.model, model.scheme)[0, 0].figure.set_size_inches(8, 5.5)
    save("modes")
    draw_heads(model.scheme)
    return 0


def draw_steps(model: jaxfit.Model, crop: np.ndarray, path: jax.Array) -> None:
    """Landmarks after some of the steps, and windows that the next step looks into."""
    space, windows = model.cascade.space, model.cascade.windows
    square = jnp.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2
    _, axes = plt.subplots(1, len(SHOWN), figsize=(12, 3.3), layout="constrained")
    for ax, step in zip(axes, SHOWN, strict=True):
        ax.imshow(crop, cmap="gray", vmin=0, vmax=255)
        for line in model.scheme.lines:
            ax.plot(*path[step][jnp.array(line)].T, color="cyan", linewidth=1)
        params = space.encode(path[step])
        if step < len(windows):
            window = windows[step] * space.scale(params) * rotate(square, space.rotation(params))
            for landmark in WITH_WINDOWS:
                ax.plot(*(path[step][landmark] + window).T, color="yellow", linewidth=1)
        ax.set_title(f"after step {step}" if step else "start", fontsize=10)
        ax.set(xlim=(0, len(crop) - 1), ylim=(len(crop) - 1, 0))
        ax.axis("off")
    save("steps")


def draw_descriptors(model: jaxfit.Model, crop: np.ndarray, landmarks: jax.Array) -> None:
    """A landmark's descriptor in the first step and in the last."""
    space, windows = model.cascade.space, model.cascade.windows
    descriptor: Any = model.cascade.descriptor  # SIFT
    params = space.encode(landmarks)
    _, axes = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
    for ax, step in zip(axes, (0, len(windows) - 1), strict=True):
        side = float(windows[step] * space.scale(params))
        angle = float(space.rotation(params))
        plot_descriptor(descriptor, crop, landmarks[CORNER], side, angle, ax=ax)
        ax.set_title(f"step {step + 1}: {side:.0f} pixels", fontsize=10)
    save("descriptor")


def draw_heads(scheme: Scheme) -> None:
    """The mean head of the 3D shape model before the camera, turned to both sides."""
    mean = np.asarray(load_head_model().of(scheme, variance=0.95).mean)
    reach = 1.1 * np.linalg.norm(mean, axis=1).max()
    _, axes = plt.subplots(1, len(YAWS), figsize=(12, 2.2), layout="constrained")
    for ax, yaw in zip(axes, YAWS, strict=True):
        seen = mean @ np.asarray(pose_rotation(jnp.array([0.0, 0.0, yaw]))).T
        for line in scheme.lines:
            ax.plot(*seen[list(line), :2].T, color="0.8", linewidth=1.2)
        ax.scatter(*seen[:, :2].T, c=-seen[:, 2], s=10, zorder=2)
        ax.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
        ax.set_title(f"yaw {yaw}°".replace("-", "−"), fontsize=10)
        ax.axis("off")
    save("heads")


def save(name: str) -> None:
    save_figure(plt.gcf(), FOLDER / f"{name}.png", dpi=90)
    plt.close()


if __name__ == "__main__":
    sys.exit(main())

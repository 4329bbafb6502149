"""The methods that can be trained, and the options of training."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from math import isfinite
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit.cascade.greedy import Greedy
from jaxfit.cascade.starts import Starts
from jaxfit.descriptors.dense import Dense
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.descriptors.sift import Sift
from jaxfit.errors import InputError
from jaxfit.heads.model import DEFAULT_HEAD_MODEL, load_head_model
from jaxfit.image.frame import Frame
from jaxfit.schemes.known import SCHEMES
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.asm import likely_radius
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.points import PointSpace, mean_face
from jaxfit.shapes.similarity import SimilarityASM, learn_similarity_asm
from jaxfit.shapes.space import ShapeSpace


@dataclass(frozen=True)
class Options:
    """How to train a model.

    Attributes:
        greedy: how the cascade is learned.
        starts: how many starts fitting shall use. With more than one, the starts of training are turned, too, so that
            fits from wrongly turned starts come to the face.
        shape_variance: share of the shape's variance that an Active Shape Model keeps, in (0, 1]; the thesis's is 0.95.
        sigmas: radius of the ellipsoid that an Active Shape Model's coefficients are kept in, in standard deviations.
            The thesis's is 3; but the more modes there are, the farther out faces lie, and most are cut off by 3. None
            takes the radius that holds as many of normally distributed faces as ±3 hold of normal numbers, 99.7 %.
        head_model: 3D head model of the 3D methods: a bundled one's name, or a file of ``scripts/build_head.py``.
        mirror: train on mirrored pictures too.
        detectors: run the YuNet and Haar detectors on the training pictures to learn how faces lie in their boxes,
            which takes some minutes; without, the model knows only boxes around the landmarks, and those that were
            measured for its scheme.
        descriptor: what is seen at a landmark; None is SIFT in windows that turn with the face, but upright ones for
            SDM from a single start.
        frame: size of the crops; None is what suits the descriptor.

    Raises:
        InputError: an option out of range.
    """

    greedy: Greedy = field(default_factory=Greedy)
    starts: Starts = field(default_factory=Starts)
    shape_variance: float = 0.99
    sigmas: float | None = None
    head_model: str = DEFAULT_HEAD_MODEL
    mirror: bool = True
    detectors: bool = True
    descriptor: Descriptor | None = None
    frame: Frame | None = None

    def __post_init__(self) -> None:
        sigmas = 3.0 if self.sigmas is None else self.sigmas
        if not (isfinite(sigmas) and sigmas > 0 and 0 < self.shape_variance <= 1):
            raise InputError(
                "expected sigmas > 0 and 0 < shape_variance <= 1; got "
                f"sigmas {self.sigmas} and shape_variance {self.shape_variance}"
            )

    def but(self, **values: Any) -> "Options":
        """These options with some changed; those of ``greedy`` can be named like its own: ``options.but(ridge=0)``.

        Raises:
            InputError: a value out of range.
        """
        greedy = {name: values.pop(name) for name in _OF_GREEDY if name in values}
        if greedy:
            values["greedy"] = replace(values.get("greedy", self.greedy), **greedy)
        return replace(self, **values)

    def flat(self) -> dict[str, Any]:
        """The options by name, those of ``greedy`` among them."""
        own = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "greedy"}
        return asdict(self.greedy) | own


_OF_GREEDY = tuple(each.name for each in fields(Greedy))


def _point_space(faces: np.ndarray, scheme: Scheme, options: Options, side: float) -> PointSpace:
    return PointSpace(jnp.asarray(mean_face(faces, side), jnp.float32))


def _similarity_asm(faces: np.ndarray, scheme: Scheme, options: Options, side: float) -> SimilarityASM:
    points = jnp.asarray(faces, jnp.float32)
    return learn_similarity_asm(points, side, options.shape_variance, options.sigmas)


def camera_asm(faces: np.ndarray, scheme: Scheme, options: Options, side: float) -> CameraASM:
    """The shape space of the 3D methods. Pictures do not show depth: its shape model is that of a head model."""
    model = load_head_model(options.head_model).in_pixels(scheme, options.shape_variance, side)
    sigmas = likely_radius(len(model.deviations)) if options.sigmas is None else options.sigmas
    return CameraASM(model, jnp.float32(sigmas))


@dataclass(frozen=True)
class Method:
    """What makes a method.

    Attributes:
        learn_space: learns the shape space from faces (N, L, 2) of a scheme, given in units of their bounding squares;
            the last argument is the side of the canonical face, in pixels.
        descriptor: what is seen at a landmark by default.
        in_3d: whether it finds the face in 3D.
        fewest: landmarks that it needs.
    """

    learn_space: Callable[[np.ndarray, Scheme, Options, float], ShapeSpace]
    descriptor: Descriptor
    in_3d: bool = False
    fewest: int = 3

    @property
    def aligns(self) -> bool:
        """Whether a 3D shape model is aligned to the landmarks of a 2D one."""
        return self.in_3d and self.learn_space is not camera_asm


METHODS = {
    "sdm": Method(_point_space, Sift("upright"), fewest=2),
    "parametric": Method(_similarity_asm, Sift("face")),
    "alignment3d": Method(_similarity_asm, Sift("face"), in_3d=True),
    "regression3d": Method(camera_asm, Sift("face"), in_3d=True),
}


def method_named(name: str) -> Method:
    """The method of a name.

    Raises:
        InputError: there is none.
    """
    if name not in METHODS:
        raise InputError(f"expected a method among {', '.join(METHODS)}; got {name!r}")
    return METHODS[name]


def default_descriptor(method: str, starts: Starts) -> Descriptor:
    """What is seen at a landmark by default: from several starts, in windows that turn with the face."""
    return METHODS[method].descriptor if starts.count == 1 else Sift("face")


# Of schemes of one's own: as many disturbed copies as make so many faces of few, and at most so many of each.
_ENOUGH, _MOST_COPIES = 400, 9


def options_for(scheme: Scheme, faces: int) -> Options:
    """The options that models are trained with unless something else is asked for.

    Of objects in a scheme of one's own there are few pictures, often large ones, and nothing is known of how they lie:
    models learn from disturbed copies as well, from starts that are spread wider, at twice the resolution. They learn
    from mirrored pictures only where the scheme says which points change places in them.

    Args:
        scheme: what the landmarks mean.
        faces: how many are learned from.
    """
    if scheme.name in SCHEMES:
        return Options()
    copies = min(_MOST_COPIES, max(0, _ENOUGH // max(faces, 1) - 1))
    mirror = scheme.mirror is not None
    return Options(greedy=Greedy(spread=1.4, copies=copies), mirror=mirror, descriptor=Dense(zoom=2))


def view_of(method: str, options: Options) -> tuple[Descriptor, Frame]:
    """What a method sees at a landmark, and the size of its crops, with these options."""
    descriptor = options.descriptor or default_descriptor(method, options.starts)
    return descriptor, options.frame or descriptor.frame

"""A model: a trained cascade with what is needed to use it on pictures."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jax import numpy as jnp

from jaxfit.cascade.confidence import Confidence
from jaxfit.cascade.fit import space_3d_of
from jaxfit.cascade.model import Cascade
from jaxfit.cascade.starts import Starts
from jaxfit.cascade.uncertainty import Uncertainty
from jaxfit.errors import InputError
from jaxfit.models.digests import Digests
from jaxfit.models.placements import Placement, placements_of
from jaxfit.modes import own_modes
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.space import ShapeSpace3D, Start

SQUARE = "square"  # the kind of box that every model knows: roughly the bounding square of the landmarks


@dataclass(frozen=True)
class Model:
    """A trained cascade, what its landmarks mean, and how faces lie in boxes.

    Attributes:
        cascade: the trained parameters: the pytree that jitted functions take.
        scheme: what the landmarks mean.
        placements: for each kind of face box that was measured in training, where faces lie in it; ``"square"`` is
            always there.
        training: how it was made: method, options, numbers of faces; plain JSON values.
        aligned: for 3D alignment, the 3D shape space that is aligned to the landmarks which the cascade finds; None for
            other methods.
        confidence: how likely its fits are to be good; None: it was not learned.
        uncertainty: how far each landmark may be off, and whether it can be seen; None: it was not learned.
        learned: (N,) uint64, sorted: digests of the pictures that it learned from, of their grey pixels, so that they
            are known under other names, too; None: it does not say, as models of earlier versions.
    """

    cascade: Cascade
    scheme: Scheme
    placements: dict[str, Placement]
    training: dict[str, Any] = field(default_factory=dict)
    aligned: ShapeSpace3D | None = None
    confidence: Confidence | None = None
    uncertainty: Uncertainty | None = None
    learned: Digests | None = None

    def __post_init__(self) -> None:
        if SQUARE not in self.placements:
            raise InputError(f"a model needs the placement of {SQUARE!r} boxes; got {sorted(self.placements)}")

    def __repr__(self) -> str:
        # Not the arrays, which would fill a notebook's page.
        knows = [f"{self.scheme.count} landmarks ({self.scheme.name})"]
        knows += ["3D shape and pose"] * (self.space_3d is not None) + ["confidence"] * (self.confidence is not None)
        how = f"{self.training.get('method', 'trained')} in {len(self.cascade.weights)} steps"
        return f"<jaxfit model: {', '.join(knows)}; {how} on {self.cascade.descriptor}>"

    @cached_property  # to ask a space for its methods takes long
    def space_3d(self) -> ShapeSpace3D | None:
        """The shape space of the model's 3D results; None if it has none."""
        return space_3d_of(self.cascade, self.aligned)

    @cached_property
    def mean_face(self) -> np.ndarray:
        """(L, 2) float32: the mean face, upright and seen from the front, in crop pixels, its centroid at 0."""
        space = self.cascade.space
        with own_modes():
            upright = Start(*(jnp.array(each, jnp.float32) for each in ([0.0, 0.0], 1.0, 0.0)))
            mean = space.landmarks(space.place(upright))
            return np.asarray(mean - mean.mean(0))

    def unshifted(self) -> "Model":
        """The same model with fits that lie on what they mark, even if its labels lay ``cascade.frame.shift`` pixels
        beside it."""
        return replace(self, cascade=replace(self.cascade, frame=replace(self.cascade.frame, shift=0.0)))

    @property
    def starts(self) -> Starts:
        """The starts that the model was trained for; a single one if it does not say."""
        return trained_starts(self.training)

    @cached_property
    def known_placements(self) -> dict[str, Placement]:
        """For each kind of box that the model can start from, where faces lie in it: what was measured on other faces
        with the same landmarks, or better, in training."""
        return placements_of(self.scheme.name) | self.placements

    def placement(self, kind: str) -> Placement:
        """Where faces lie in boxes of a kind.

        Raises:
            InputError: that kind of box was never measured for landmarks like the model's.
        """
        known = self.known_placements
        if kind not in known:
            raise InputError(
                f"this model knows boxes of the kinds {', '.join(known)}; got {kind!r}: give it boxes of a kind that "
                f"it knows (--boxes, boxes=; {SQUARE!r} is the bounding square of all landmarks). Training learns "
                "the kinds of the detectors that find ten of its faces or more, and whole pictures of your own objects "
                "from five that show one each"
            )
        return known[kind]


def trained_starts(training: dict[str, Any]) -> Starts:
    """The starts that ``Model.training`` says the model was trained for."""
    return Starts(training.get("initialisations", 1), *training.get("rotations", ()))

"""A model: a trained cascade with what is needed to use it on pictures."""

from dataclasses import dataclass, field
from typing import Any

from jaxfit.cascade.fit import solid_of
from jaxfit.cascade.model import Cascade
from jaxfit.data.placements import Placement
from jaxfit.exceptions import InputError
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.schemes import Scheme

SQUARE = "square"  # the kind of box that every model knows: the bounding square of the landmarks, give or take


@dataclass(frozen=True)
class Model:
    """A trained cascade, what its landmarks mean, and how faces lie in boxes.

    Attributes:
        cascade: the trained parameters: the pytree that jitted functions take.
        scheme: what the landmarks mean.
        placements: for each kind of face box, where faces lie in it; ``"square"`` is always there.
        training: how it was made: method, options, numbers of faces; plain JSON values.
        head: for 3D alignment, what is aligned to the landmarks that the cascade finds; None for other methods.
    """

    cascade: Cascade
    scheme: Scheme
    placements: dict[str, Placement]
    training: dict[str, Any] = field(default_factory=dict)
    head: CameraASM | None = None

    def __post_init__(self) -> None:
        if SQUARE not in self.placements:
            raise InputError(f"a model needs the placement of {SQUARE!r} boxes; got {sorted(self.placements)}")

    @property
    def solid(self) -> CameraASM | None:
        """The shape space of the model's 3D results; None if it has none."""
        return solid_of(self.cascade, self.head)

    def placement(self, kind: str) -> Placement:
        """Where faces lie in boxes of a kind.

        Raises:
            InputError: the model was not trained for that kind of box.
        """
        if kind not in self.placements:
            raise InputError(f"this model knows boxes of the kinds {', '.join(self.placements)}; got {kind!r}")
        return self.placements[kind]

"""What a landmark's neighbourhood looks like, as a vector; pure JAX, for one landmark."""

from jaxfit.descriptors.dense import Dense
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.descriptors.sift import Sift
from jaxfit.errors import InputError

# What model files, experiments and the command line call them; a new one, as `Descriptor` asks for, is a line here.
DESCRIPTORS: dict[str, type[Sift] | type[Dense]] = {"sift": Sift, "dense": Dense}


def kind_of(descriptor: Descriptor) -> str:
    """What a descriptor is called in ``DESCRIPTORS``."""
    return next(name for name, kind in DESCRIPTORS.items() if type(descriptor) is kind)


def descriptor_like(usual: Descriptor, kind: str) -> Descriptor:
    """The usual descriptor if it is of this kind, or one that is, whose windows turn if those of the usual one do.

    Raises:
        InputError: there is no such kind.
    """
    if kind not in DESCRIPTORS:
        raise InputError(f"expected a descriptor among {', '.join(DESCRIPTORS)}; got {kind!r}")
    wanted = DESCRIPTORS[kind]
    return usual if type(usual) is wanted else wanted(orientation="face" if usual.turns else "upright")

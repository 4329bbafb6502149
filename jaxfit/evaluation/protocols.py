"""Protocols of published comparisons: what they divide errors by, and which faces they are about."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxfit.errors import InputError
from jaxfit.labels.records import Dataset


@dataclass(frozen=True)
class Protocol:
    """How a benchmark is measured.

    Attributes:
        about: what it is, in words.
        normaliser: what errors are relative to.
        faces: how many faces it has, in all datasets together: the numbers that publications have.
        points: how many landmarks the labels have.
    """

    about: str
    normaliser: str
    faces: tuple[int, ...]
    points: int = 68


_COMMON = "300-W's common subset: the test sets of HELEN (330 pictures) and of LFPW (224), 68 points"
_AFLW2000 = (
    "AFLW2000-3D, 68 points, hidden ones where they would be seen through the head; mean distance over the root of "
    "width times height of the box around the labels; means over |yaw| up to 30, 60 and 90 degrees, and that of the "
    "three"
)
# By the names that the command line knows.
PROTOCOLS = {
    "300w-common": Protocol(f"{_COMMON}; mean distance over that of the outer eye corners", "outer", (554,)),
    "300w-common-pupils": Protocol(f"{_COMMON}; mean distance over that of the pupils", "pupil", (554,)),
    "aflw2000": Protocol(
        f"{_AFLW2000}. Labels are 3DDFA's fits (Zhu and others, 2016). Publications have landmarks of all 2,000 "
        "pictures (aflw2000-all:), poses of the 1,969 without an angle beyond 99 degrees (aflw2000:)",
        "area",
        (1969, 2000),
    ),
    "aflw2000-re": Protocol(
        f"{_AFLW2000}. Labels of Bulat and Tzimiropoulos (2017), who annotated the pictures again", "area", (2000,)
    ),
}


def protocol_notes(name: str, datasets: Sequence[Dataset]) -> list[str]:
    """What is said of a protocol with these datasets: what it is, and where they are not what it is about.

    Raises:
        InputError: there is no such protocol, or labels of another number of points.
    """
    if name not in PROTOCOLS:
        raise InputError(f"expected a protocol of {', '.join(PROTOCOLS)}; got {name!r}")
    protocol = PROTOCOLS[name]
    for dataset in datasets:
        if dataset.scheme.count != protocol.points:
            raise InputError(
                f"{dataset.spec}: {name} is about faces of {protocol.points} points; got {dataset.scheme.count}"
            )
    notes = [f"{name}: {protocol.about}"]
    faces = sum(len(dataset.faces) for dataset in datasets)
    if faces not in protocol.faces:
        usual = " or ".join(f"{count:,}" for count in protocol.faces)
        notes.append(f"{name}: it has {usual} faces; these are {faces:,}: figures are not those of publications")
    return notes

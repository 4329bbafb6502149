"""Face boxes that come in a file, made ready for a model."""

from pathlib import Path

from jaxfit.data.boxes import GivenBox, read_boxes
from jaxfit.errors import InputError
from jaxfit.models.model import SQUARE, Model


def read_known_boxes(path: str | Path | None, kind: str | None, model: Model) -> dict[str, list[GivenBox]] | None:
    """The boxes of a file, as ``jaxfit.data.read_boxes`` reads them, each with its kind; None without a file.

    Args:
        path: of the CSV file, if there is one.
        kind: what drew all boxes; None takes what the file's column ``box`` says, and squares where it says nothing.
        model: that will fit the faces.

    Raises:
        InputError: the file is wrong, the model does not know a kind of box, or there is a kind but no file.
    """
    if path is None:
        if kind is not None:
            raise InputError(f"the kind {kind} says what drew the boxes of a file; give that file too")
        return None
    if kind is not None:
        model.placement(kind)
    named = {
        name: [box._replace(kind=kind or box.kind or SQUARE) for box in boxes]
        for name, boxes in read_boxes(path).items()
    }
    try:
        for drawn_by in {box.kind for boxes in named.values() for box in boxes}:
            model.placement(drawn_by)
    except InputError as error:
        raise InputError(f"{path}: its column box says what drew a box, unless --box-kind does; {error}") from None
    return named

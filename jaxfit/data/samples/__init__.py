"""Pictures that come with the package, to try things with; ORIGIN.txt says where they are from."""

from importlib import resources
from pathlib import Path

from jaxfit.errors import InputError

_SUFFIX = ".jpg"


def sample(name: str = "portrait") -> Path:
    """The file of a picture that comes with the package: ``"portrait"``, a face that looks at the camera.

    Raises:
        InputError: no such picture.
    """
    folder = Path(str(resources.files(__name__)))
    names = sorted(file.stem for file in folder.glob(f"*{_SUFFIX}"))
    if name not in names:
        raise InputError(f"no sample picture {name!r}; expected one of {', '.join(names)}")
    return folder / f"{name}{_SUFFIX}"

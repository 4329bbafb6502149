"""Names of datasets, methods, tables and figures, which become parts of file names."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from jaxfit.errors import InputError

_NAME = re.compile(r"[A-Za-z0-9]+([._-][A-Za-z0-9]+)*")  # a file can have it on every system


def check_names(names: Sequence[str], where: str) -> None:
    """Check that names can be file names in one folder.

    Args:
        names: the names.
        where: what has them, for the message.

    Raises:
        InputError: one has other characters than letters, digits and single ``.``, ``_`` or ``-`` between them, or two
            differ in nothing or only in case.
    """
    taken = set()
    for name in names:
        if not _NAME.fullmatch(name):
            raise InputError(
                f"{where}: expected a name of letters and digits with single '.', '_' or '-' between them, as it goes "
                f"into file names; got {name!r}"
            )
        if name.casefold() in taken:  # some file systems do not distinguish case
            raise InputError(f"{where}: two are called {name}; give each a name of its own")
        taken.add(name.casefold())


def folder_names(paths: Sequence[str]) -> list[str]:
    """What folders are called, wherever they are: their own names. Of several of one name the later ones are numbered,
    as they hold other people."""
    numbers: Counter[str] = Counter()
    names: dict[Path, str] = {}
    for path in dict.fromkeys(map(Path, paths)):
        numbers[path.name] += 1
        names[path] = path.name if numbers[path.name] == 1 else f"{path.name}-{numbers[path.name]}"
    return [names[Path(path)] for path in paths]

"""Numbers in text files and on the command line."""


def number(text: str) -> float:
    """The number that a text says, as all programs read it: Python's ``float`` also takes ``1_5`` for 15.

    Raises:
        ValueError: it says none.
    """
    return float(_usual(text))


def whole_number(text: str) -> int:
    """The whole number that a text says, as `number`.

    Raises:
        ValueError: it says none.
    """
    return int(_usual(text))


def _usual(text: str) -> str:
    if "_" in text or not text.isascii():
        raise ValueError(f"expected a number of the digits 0 to 9; got {text!r}")
    return text

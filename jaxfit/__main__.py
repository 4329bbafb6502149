"""``python -m jaxfit``: the ``jaxfit`` command."""

from jaxfit.cli.main import program

if __name__ == "__main__":
    program()

"""``python -m jaxfit``: the ``jaxfit`` command."""

import sys

from jaxfit.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

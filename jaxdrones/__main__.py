"""`python -m jaxdrones`: the command line."""

import sys

from jaxdrones.cli import main

if __name__ == "__main__":
    sys.exit(main())

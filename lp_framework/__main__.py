"""`python -m lp_framework`."""

import sys

from lp_framework.cli import main

if __name__ == "__main__":
    sys.exit(main())

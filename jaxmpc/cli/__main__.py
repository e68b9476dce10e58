"""``python -m jaxmpc.cli``."""

import sys

from jaxmpc.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

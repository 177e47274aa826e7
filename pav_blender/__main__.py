"""`python -m pav_blender VERB`, the same as `pav VERB`."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

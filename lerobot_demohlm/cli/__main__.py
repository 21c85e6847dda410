"""``python -m lerobot_demohlm.cli``."""

import sys

from lerobot_demohlm.cli import main

if __name__ == "__main__":
    sys.exit(main())

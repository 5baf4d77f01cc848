# SPDX-License-Identifier: Apache-2.0
"""Run the command `starpos` as `python -m starpos`."""

import sys

from starpos.cli import main

if __name__ == "__main__":
    sys.exit(main())

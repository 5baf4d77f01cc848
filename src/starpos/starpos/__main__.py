# SPDX-License-Identifier: Apache-2.0
"""`python -m starpos` is `starpos`."""

import sys

from starpos.cli import main

if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""Print which of the named modules this interpreter cannot import, one a line.

With --have, print as pip's constraints the versions that apt has brought and pip must keep.
"""

import sys
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

# fmt: off
KEEP = [
    "numpy", "scipy", "astropy", "pyerfa", "opencv-python", "opencv-python-headless", "pyserial", "PyYAML",
]
# fmt: on

if sys.argv[1:] == ["--have"]:
    for name in KEEP:
        try:
            print(f"{name}=={version(name)}")
        except PackageNotFoundError:
            continue
else:
    for module in sys.argv[1:]:
        if find_spec(module) is None:
            print(module)

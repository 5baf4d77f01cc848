# SPDX-License-Identifier: Apache-2.0
"""Print which Python this is, and where its packages are not those that a list names first (`said.py LIST`)."""

import platform
import re
import sys
from importlib.metadata import version
from pathlib import Path

# where a package has a line for each of several interpreters, the first is Ubuntu's
wanted = dict(reversed(re.findall(r"^([\w-]+)==(\S+)", Path(sys.argv[1]).read_text(), re.MULTILINE)))
others = [
    f"{name} {version(name)} for {number}" for name, number in wanted.items() if version(name) != number
]
print(", ".join([f"Ubuntu 24.04's versions with Python {platform.python_version()}", *others]))

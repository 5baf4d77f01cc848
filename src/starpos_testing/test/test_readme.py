# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import starpos_testing


def test_every_module_is_in_the_readmes_table():
    (folder,) = starpos_testing.__path__
    modules = {p.stem for p in Path(folder).iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()}
    rows = (Path(__file__).parents[1] / "README.md").read_text().splitlines()
    named = {row.split("`")[1] for row in rows if row.startswith("| `")}
    assert named == modules - {"__init__"}

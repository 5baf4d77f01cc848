# SPDX-License-Identifier: Apache-2.0
"""Write docs/tutorials/method.ipynb, the notebook of docs/tutorials/method.md: `python tools/data/notebook.py`.

Its text and its code are the page's; a test compares.
"""

import json
import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "method.md"
BLOCK = re.compile(r"^```python\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


def cells(page: str) -> list[dict]:
    """The cells of a page: text, and the lines of its examples without prompts and outputs."""
    made = []
    for k, part in enumerate(BLOCK.split(page)):
        kind = "code" if k % 2 else "markdown"
        if kind == "code":
            part = "\n".join(line[4:] for line in part.splitlines() if line.startswith((">>> ", "... ")))
        if part.strip():
            more = {"outputs": [], "execution_count": None} if kind == "code" else {}
            source = part.strip().splitlines(keepends=True)
            made.append({"cell_type": kind, "id": f"cell-{k}", "metadata": {}, "source": source} | more)
    return made


def notebook(page: str) -> str:
    """The notebook of a page, as JSON."""
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    page = re.sub(r"\s*The same text is a\s+\[notebook\]\(method.ipynb\)\.", "", page)
    whole = {"cells": cells(page), "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    PAGE.with_suffix(".ipynb").write_text(notebook(PAGE.read_text()))

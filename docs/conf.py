# SPDX-License-Identifier: Apache-2.0
"""The site of the documents: `make docs` builds it into build/docs.

Sphinx reads from the root of the repository, so that the packages' READMEs are pages too and links hold on both sides.
"""

import os
import re
from pathlib import Path

import starpos
from starpos.cli import COMMANDS, parser_for

ROOT = Path(__file__).resolve().parents[1]
# lines of a docstring that describe something by its name, in columns or after a colon
COLUMNS, NAMED = re.compile(r"[\w, ]*\w(?: \([^)]*\))? {2,}\S"), re.compile(r"[\w, ]*\w(?: \([^)]*\))?: \S")
# an entry of a section of numpydoc
ENTRY = re.compile(r"\*{0,2}\w+(?:, \w+)* : \S")

# as wide as a line of code on a page
os.environ["COLUMNS"] = "84"

project = "starpos"
author = "starpos maintainers"
version = release = starpos.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
root_doc = "docs/index"
include_patterns = [
    "docs/**",
    "*.md",
    "*/README.md",
    "*/PROTOCOL.md",
    "src/*/README.md",
    "*/CHANGELOG.rst",
    "src/*/CHANGELOG.rst",
]
exclude_patterns = ["build", "install", "log", "demo", "tools", ".*", "**/.*", "**/node_modules"]
myst_heading_anchors = 4
highlight_language = "none"
# names of other projects, for which this would need the network
nitpick_ignore_regex = [("py:.*", ".*")]
suppress_warnings = ["myst.header"]
html_theme = "furo"
html_title = "starpos"
html_static_path: list[str] = []
autodoc_member_order = "bysource"
autodoc_typehints = "none"


def about_names() -> str:
    """Directives of autodoc for the public names, by the folder of `starpos` that they live in."""
    made, folder = [], ""
    for name in sorted(starpos.__all__, key=lambda n: (starpos._HOMES[n].split(".")[0], n)):
        home = starpos._HOMES[name]
        if home.split(".")[0] != folder:
            folder = home.split(".")[0]
            made.append(f"\n## starpos.{folder}\n")
        is_class = isinstance(getattr(starpos, name), type)
        members = "   :members:\n" if is_class else ""
        kind = "autoclass" if is_class else "autofunction"
        made.append(f"```{{eval-rst}}\n.. {kind}:: starpos.{name}\n{members}```\n")
    return "\n".join(made)


def about_commands() -> str:
    """What --help says of every command."""
    made = []
    for name in COMMANDS:
        [commands] = (action for action in parser_for([name])._actions if isinstance(action.choices, dict))
        made.append(f"### starpos {name}\n\n```\n{commands.choices[name].format_help()}```\n")
    return "\n".join(made)


# Words that newcomers search for, by the page that the site's search should give first.
SEARCHED = {
    "docs/how-to/calibrate": ("calibration", "calibrate", "misalignment", "boresight"),
    "docs/how-to/deflection": ("zenith camera", "plumb line", "deflection of the vertical"),
    "docs/how-to/gnss": ("GPS", "GNSS", "jamming", "spoofing"),
    "docs/how-to/time": ("clock", "wrong clock", "chrony", "NTP", "PPS"),
    "docs/sensors": ("tilt", "tiltmeter", "inclinometer", "accelerometer", "level"),
    "docs/navigation": ("gyro", "gyroscope", "IMU", "moving"),
    "docs/tutorials/azimuth": ("compass", "north", "true north", "gyrocompass", "azimuth"),
    "docs/tutorials/disk": ("plate solving", "plate solve", "plate solver", "astrometry", "plate scale"),
    "docs/tutorials/robot": ("GPS denied", "GNSS denied", "star tracker", "celestial navigation", "robot"),
}
MADE = {"<!-- commands -->": about_commands, "<!-- public names -->": about_names}


def fill_in(app: object, name: str, source: list[str]) -> None:
    """Put what is made of the code into a page, and the words by which the search finds it."""
    for mark, make in MADE.items():
        if mark in source[0]:
            source[0] = source[0].replace(mark, make())
    if words := SEARCHED.get(name):
        title, _, rest = source[0].partition("\n")
        entries = "".join(f"   ! single: {word}\n" for word in words)
        source[0] = f"{title}\n\n```{{eval-rst}}\n.. index::\n{entries}```\n{rest}"


def as_written(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Keep docstrings as they are written: they are plain text, with tables in columns, and no reStructuredText."""
    made = []
    for paragraph in "\n".join(lines).split("\n\n"):
        rows = paragraph.split("\n")
        if len(rows) > 1 and rows[1] and set(rows[1]) == {"-"}:
            made += [f".. rubric:: {rows[0]}", ""]
            rows = rows[2:]
        plain = [re.sub(r"([\\*`_|])", r"\\\1", row).strip() for row in rows]
        if any(row.startswith(">>> ") for row in rows):
            made += ["::", "", *(f"    {row}" for row in rows), ""]
        elif any(ENTRY.match(row) for row in rows):
            # a row that goes on is continued in its line block
            made += [
                f"  {p}" if row.startswith(" ") else f"| {p}" for row, p in zip(rows, plain, strict=True)
            ]
            made.append("")
        elif any(COLUMNS.match(row) or row.startswith("    ") for row in rows):
            made += ["::", "", *(f"    {row}" for row in rows), ""]
        elif any(NAMED.match(row) for row in rows):
            made += [*(f"| {row}" for row in plain if row), ""]
        else:
            made += [*plain, ""]
    lines[:] = made


def lead_in(app: object, error: Exception | None) -> None:
    """Lead from the site's root to its first page; raise ValueError where SEARCHED names a page that is not there."""
    if error is None:
        if gone := SEARCHED.keys() - app.env.all_docs.keys():
            raise ValueError(
                f"docs/conf.py: SEARCHED names pages that are not there: {', '.join(sorted(gone))}"
            )
        page = '<!doctype html><title>starpos</title><meta http-equiv="refresh" content="0; url=docs/index.html">\n'
        (Path(app.outdir) / "index.html").write_text(page)


def setup(app: object) -> None:
    app.connect("source-read", fill_in)
    app.connect("autodoc-process-docstring", as_written)
    app.connect("build-finished", lead_in)

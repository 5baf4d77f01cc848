# SPDX-License-Identifier: Apache-2.0
"""Tutorials and how-tos link a term of the glossary where they first use it."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_documents import ROOT, headings

GLOSSARY = ROOT / "docs" / "glossary.md"
PAGES = sorted(p for folder in ("tutorials", "how-to") for p in (ROOT / "docs" / folder).glob("*.md"))
# heading of the glossary, as an anchor: the words that a newcomer may not know
TERMS = {
    "a1-a2-a3-a4": r"A3",
    "astronomic-latitude-longitude": r"astronomic",
    "base-link": r"base link",
    "boresight-optical-axis": r"boresight|optical axis",
    "covariance": r"covariances?",
    "deflection-of-the-vertical": r"deflection of the vertical",
    "face": r"(?:four|each|of|another) faces?",
    "geodetic-latitude-longitude": r"geodetic",
    "icrs": r"ICRS",
    "lost-in-space": r"lost in space",
    "misalignment": r"misalignment",
    "plate-scale": r"plate scale",
    "plate-solving": r"plate solvers?|plate solving",
    "plumb-line": r"plumb line",
    "pose": r"poses?",
    "roll": r"position angle",
    "sigma-1-sigma": r"1 sigma",
    "ut1": r"UT1",
    "zenith-distance": r"zenith distance",
}
# code, headings, tables, addresses of links, quoted names
NO_PROSE = re.compile(
    r"^ *```.*?^ *```$|^(?: {4}|\t)[^\n]*|^#[^\n]*|^ *\|[^\n]*|(?<=\])\([^)\s]*\)|`[^`]*`",
    re.DOTALL | re.MULTILINE,
)


def prose(text: str) -> str:
    """The text with blanks in place of what is no prose, so that places stay the same."""
    return NO_PROSE.sub(lambda found: re.sub(r"[^\n]", " ", found.group()), text)


def unlinked(text: str) -> Iterator[tuple[str, re.Match]]:
    """Anchors of the terms whose first use stands in no link, each with that use."""
    plain = prose(text)
    links = [found.span() for found in re.finditer(r"\[[^\]]*\]\([^)\s]*\)", text)]
    for anchor, words in TERMS.items():
        first = re.search(rf"(?<![\w-])(?:{words})(?![\w-])".replace(" ", r"\s+"), plain)
        if first and not any(begin < first.start() < end for begin, end in links):
            yield anchor, first


def test_the_glossary_has_every_term():
    assert set(TERMS) - headings(GLOSSARY) == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_a_term_is_linked_where_it_is_first_used(page: Path):
    assert [anchor for anchor, _ in unlinked(page.read_text())] == []


def test_a_term_without_a_link_is_found():
    assert [anchor for anchor, _ in unlinked("# A3\n\n`A3` is [A3](x.md), and a plate\nscale.")] == [
        "plate-scale"
    ]
    assert [anchor for anchor, _ in unlinked("A3 is [A3](x.md).")] == ["a1-a2-a3-a4"]

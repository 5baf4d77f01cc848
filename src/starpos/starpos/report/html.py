# SPDX-License-Identifier: Apache-2.0
"""What all pages of a report are made of: the document, figures, angles."""

import base64
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from starpos import __version__
from starpos.report.style import Picture

STYLE = """
:root { color-scheme: light dark; --ink: #1d2329; --soft: #5a646e; --paper: #fbfbf9; --card: #ffffff; --line: #dcdfe2;
  --bad: #b3401f; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e7ea; --soft: #a2abb3; --paper: #15181b; --card: #1d2125;
  --line: #363c42; --bad: #ff9a76; } img { filter: invert(0.89) hue-rotate(180deg); } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.2rem; max-width: 80rem; background: var(--paper); color: var(--ink);
  font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; margin: .4rem 0; } h2 { font-size: 1.3rem; margin: 2.4rem 0 .6rem; }
.place { font-size: 1.25rem; font-variant-numeric: tabular-nums; margin: .2rem 0; }
.soft, figcaption, footer { color: var(--soft); font-size: .92rem; } .bad { color: var(--bad); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; background: var(--card); font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: .4rem .7rem; border: 1px solid var(--line); }
th { font-weight: 600; width: 13rem; } thead th { width: auto; }
.wide { margin-bottom: 1.2rem; } .wide table { white-space: nowrap; } a { color: inherit; }
.figures { display: grid; gap: 1.2rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 36rem), 1fr)); }
figure { margin: 0; padding: .8rem; background: var(--card); border: 1px solid var(--line); border-radius: .5rem; }
figure h3 { margin: 0 0 .5rem; font-size: 1.05rem; }
img { display: block; width: 100%; height: auto; background: #fff; }
figcaption { margin-top: .6rem; } details { margin: .6rem 0 1.2rem; } summary { cursor: pointer; }
@media (max-width: 40rem) { body { padding: .7rem; } th { width: 8rem; }
  th, td { padding: .4rem .5rem; font-size: .92rem; } }
@media print { img { filter: none; } .wide table { white-space: normal; font-size: .8rem; } }
"""


def document(title: str, parts: Sequence[str]) -> str:
    """A page that loads nothing, of a plain title and parts in HTML."""
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="generator" content="starpos {escape(__version__)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">\n"
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def figures(pictures: Sequence[Picture]) -> str:
    """Pictures with their titles and captions, in HTML."""
    if not pictures:
        return ""
    cards = "\n".join(
        f'<figure><h3>{escape(p.title)}</h3><img alt="{escape(p.title)}" '
        f'src="data:image/png;base64,{base64.b64encode(p.png).decode()}">'
        f"<figcaption>{escape(p.caption)}</figcaption></figure>"
        for p in pictures
    )
    return f'<div class="figures">\n{cards}\n</div>'


def sexagesimal(angle: float, sides: str) -> str:
    """An angle in rad as degrees, minutes and seconds to 0.01; sides: letters of its signs, such as NS."""
    seconds, parts = divmod(round(abs(float(np.degrees(angle))) * 3600 * 100), 100)
    minutes, seconds = divmod(seconds, 60)
    degrees, minutes = divmod(minutes, 60)
    side = sides[0] if angle >= 0 else sides[1]
    return f"{degrees}&deg; {minutes:02d}&prime; {seconds:02d}.{parts:02d}&Prime; {side}"


def table(rows: Iterable[tuple[str, str]]) -> str:
    """A table of names and texts, both in HTML."""
    cells = "".join(f"<tr><th>{name}</th><td>{text}</td></tr>\n" for name, text in rows)
    return f"<table>\n{cells}</table>"


def wide_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with a head, in HTML, which scrolls where the page is narrow."""
    head = "".join(f"<th>{t}</th>" for t in titles)
    body = "\n".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead>\n{body}</table></div>'

# SPDX-License-Identifier: Apache-2.0
"""How a camera that stands still has kept its pose: a line and a JSON object a night, and a page of the history."""

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from starpos.cli.console import OUTPUTS, values
from starpos.files import rows_of, save
from starpos.night.watching import Kept
from starpos.report.html import document, wide_table
from starpos.units import ARCSEC, utc_text

TITLE = "A camera that stands still"
# a limit that is brighter by more is said in a sentence
DIMMED_MAG = 1.0
# of the page's picture, px
WIDTH, HEIGHT = 800, 120


def values_of(night: Kept) -> dict:
    """A night for --json."""
    pose = night.pose
    return (
        {"night": pose.day, "utc": utc_text(pose.utc_unix_s)}
        | values(pose, "frames stars")
        | values(night, "moved_arcsec sigma_arcsec")
        | {"turned_arcsec": night.turned / ARCSEC}
        | values(pose, "focal_px limit_mag worst_limit_mag extinction extinction_sigma sky_mag")
        | values(night, "alarm")
    )


def line_of(night: dict) -> str:
    """Text of a night for people."""
    sky = "" if math.isnan(night["sky_mag"]) else ", sky V {sky_mag:.2f} per square arcsec"
    known = not math.isnan(night["extinction"])
    air = ", extinction " + (
        "{extinction:.2f} +- {extinction_sigma:.2f} mag per air mass" if known else "unknown"
    )
    return (
        "{night}: {frames} frames, {stars} stars, moved by {moved_arcsec:.1f} +- {sigma_arcsec:.1f} arcsec, focal length "
        "{focal_px:.3f} px, limit V {limit_mag:.1f} (worst frame {worst_limit_mag:.1f})" + air + sky
    ).format(**night)


def alarm_of(night: Kept) -> str:
    """Say that a camera has moved."""
    return (
        f"{night.pose.day}: the camera has moved by {night.moved_arcsec:.0f} arcsec against the {night.nights} nights "
        "before: later nights are compared with this one; calibrate it again"
    )


def dimmed_of(nights: Sequence[Kept]) -> str:
    """Say that a frame of the last of the nights shows only brighter stars than the nights do; '' if it does not."""
    pose, usual = nights[-1].pose, float(np.median([n.pose.limit_mag for n in nights]))
    if not usual - pose.worst_limit_mag > DIMMED_MAG:
        return ""
    return (
        f"{pose.day}: at {utc_text(pose.worst_unix_s)} the faintest stars were of V {pose.worst_limit_mag:.1f}, "
        f"{usual - pose.worst_limit_mag:.1f} mag brighter than usual: clouds, haze, dew on the glass, or moonlight"
    )


def write_page(path: Path, nights: Sequence[Kept]) -> None:
    """Write the history as a page; raises WriteError if it cannot be written."""
    rows, columns = [values_of(n) for n in nights], rows_of(OUTPUTS)["watch"]
    most = max([1.0, *(r["moved_arcsec"] for r in rows)])
    step = WIDTH / max(len(rows), 1)
    bars = "".join(
        f'<rect x="{k * step:.1f}" y="{HEIGHT * (1 - r["moved_arcsec"] / most):.1f}" width="{step * 0.8:.1f}" '
        f'height="{HEIGHT * r["moved_arcsec"] / most:.1f}" fill="{"crimson" if r["alarm"] else "steelblue"}"/>'
        for k, r in enumerate(rows)
    )
    cells = [
        [
            escape(("moved" if r[k] else "") if k == "alarm" else form.format(r[k]).replace("nan", "unknown"))
            for k, (_, form) in columns.items()
        ]
        for r in rows
    ]
    about = (
        f"Nights: {len(rows)}. Bars: how far each pose is from the mean of those before, up to {most:.0f} arcsec; red "
        "where it has moved."
    )
    parts = (
        f"<h1>{TITLE}</h1><p>{about}</p>",
        f'<svg width="{WIDTH}" height="{HEIGHT}">{bars}</svg>',
        wide_table([name for name, _ in columns.values()], cells),
    )
    save(path, document(TITLE, parts).encode(), "the page")

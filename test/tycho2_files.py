# SPDX-License-Identifier: Apache-2.0
"""Tycho-2's original files, written byte by byte as the ReadMe of CDS I/259 lays them out."""

from pathlib import Path

NAMES = [f"tyc2.dat.{i:02d}" for i in range(20)] + ["suppl_1.dat"]


def record(size, **fields):
    """One line of `size` bytes and a newline; each field is (first byte from 1, text)."""
    line = bytearray(b" " * size)
    for first, text in fields.values():
        line[first - 1 : first - 1 + len(text)] = text.encode()
    return bytes(line) + b"\n"


def main(
    tyc,
    ra=None,
    dec=None,
    pm=(0.0, 0.0),
    pflag=" ",
    bt="",
    vt="",
    hip="",
    observed=(10.0, 20.0),
    since=("1.50", "1.60"),
):
    """A record of tyc2.dat; ra None: neither mean place nor motion, as pflag X has it."""
    mean = {} if ra is None else {
        "ra": (16, f"{ra:12.8f}"), "dec": (29, f"{dec:12.8f}"), "pmra": (42, f"{pm[0]:7.1f}"),
        "pmde": (50, f"{pm[1]:7.1f}"), "e_ra": (58, " 10"), "e_dec": (62, " 12"), "e_pmra": (66, " 1.5"),
        "e_pmde": (71, " 2.5"), "ep_ra": (76, "1980.00"), "ep_dec": (84, "1982.00"),
    }  # fmt: skip
    one, two, three = tyc
    return record(
        206, tyc1=(1, f"{one:04d}"), tyc2=(6, f"{two:05d}"), tyc3=(12, str(three)), pflag=(14, pflag), **mean,
        bt=(111, f"{bt:>6}"), vt=(124, f"{vt:>6}"), hip=(143, f"{hip:>6}"), ra_o=(153, f"{observed[0]:12.8f}"),
        dec_o=(166, f"{observed[1]:12.8f}"), ep_o=(179, since[0]), ep_od=(184, since[1]), e_rao=(189, " 60.0"),
        e_deo=(195, " 80.0"),
    )  # fmt: skip


def supplement(tyc, flag, ra, dec, pm=None, bt="", vt="", hip=""):
    """A record of suppl_1.dat."""
    moving = {} if pm is None else {
        "pmra": (42, f"{pm[0]:7.1f}"), "pmde": (50, f"{pm[1]:7.1f}"), "e_pmra": (70, "  0.6"), "e_pmde": (76, "  0.8"),
    }  # fmt: skip
    one, two, three = tyc
    return record(
        122, tyc1=(1, f"{one:04d}"), tyc2=(6, f"{two:05d}"), tyc3=(12, str(three)), flag=(14, flag),
        ra=(16, f"{ra:012.8f}"), dec=(29, f"{dec:+012.8f}"), **moving, e_ra=(58, "  3.0"), e_dec=(64, "  4.0"),
        bt=(84, f"{bt:>6}"), vt=(97, f"{vt:>6}"), hip=(116, f"{hip:>6}"),
    )  # fmt: skip


FAINT = main((1, 1, 1), 1.0, 1.0, vt="14.000", bt="14.500")
FAINT_SUPPLEMENT = supplement((2, 1, 1), "T", 2.0, 1.0, vt="14.000", bt="14.500")


def write_files(folder: Path, contents: dict[str, bytes]) -> Path:
    """Write all files into a folder: from `contents` by name, the others with one faint star each."""
    folder.mkdir(parents=True)
    for name in NAMES:
        faint = FAINT_SUPPLEMENT if name.startswith("suppl") else FAINT
        (folder / name).write_bytes(contents.get(name, faint))
    return folder

# SPDX-License-Identifier: Apache-2.0
"""Calls for the nights of the fixture `archive`."""

import re

from cli_calls import KNOWN

from starpos.cli import main


def frames(night, pattern="*.csv"):
    return [str(p) for p in sorted(night.glob(pattern)) if p.name != "tilt.csv"]


def solve(night, *more):
    return ["solve", *frames(night), "--tilt", str(night / "tilt.csv"), *KNOWN, *map(str, more)]


def run(capfd, command):
    """Exit status, standard output, standard error without timings."""
    capfd.readouterr()
    try:
        status = main(command)
    except SystemExit as e:
        status = e.code
    out, err = capfd.readouterr()
    return status, re.sub(r'"cpu_ms": [^,}]*|\d+ ms$', "", out, flags=re.M), err

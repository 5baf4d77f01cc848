# SPDX-License-Identifier: Apache-2.0
"""The command line, called in the process of a test."""

from starpos.cli import main

# options: the optics of 15 deg across 1000 x 700 px (4636 px), the inclinometer of simulated nights, and an A3 of them
OPTICS = ("--focal-mm", "29.67", "--pixel-um", "6.4")
SENSOR = ("--inclinometer", "sca100t_calibrated")
A3 = ("--misalignment", "0", "0", "0", "--misalignment-stddev", "5", *SENSOR)


def run(capsys, *args):
    """Run a command; returns exit status, standard output, and the lines of standard error."""
    capsys.readouterr()
    try:
        status = main([str(a) for a in args])
    except SystemExit as e:
        status = e.code
    said = capsys.readouterr()
    return status, said.out, said.err.splitlines()

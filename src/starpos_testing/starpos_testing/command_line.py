# SPDX-License-Identifier: Apache-2.0
"""The command line, called in the process of a test."""

from starpos.cli import main


def run(capsys, *args):
    """Run a command; returns exit status, standard output, and the lines of standard error."""
    capsys.readouterr()
    try:
        status = main([str(a) for a in args])
    except SystemExit as e:
        status = e.code
    said = capsys.readouterr()
    return status, said.out, said.err.splitlines()

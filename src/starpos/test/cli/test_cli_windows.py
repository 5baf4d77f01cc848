# SPDX-License-Identifier: Apache-2.0
"""The commands on a system like Windows: without POSIX's calls, with a path and an output in its letters."""

import os
import subprocess
import sys

# Takes away what Windows lacks, but for what the interpreter needs here to start processes of its own.
LIKE_WINDOWS = """
import os, signal, sys
for module, names in ((os, "O_NONBLOCK O_NOCTTY getuid geteuid sched_getaffinity"), (signal, "SIGHUP SIGPIPE")):
    for name in names.split():
        delattr(module, name)
sys.modules |= dict.fromkeys(("fcntl", "resource", "termios", "pwd", "grp"))
opened = os.open
def no_folder(path, *args, **more):
    if os.path.isdir(path):
        raise PermissionError(13, "Permission denied")
    return opened(path, *args, **more)
os.open = no_folder
from starpos.cli import main
sys.exit(main(sys.argv[1:]))
"""
KNOWN = ("--misalignment", "0", "0", "0", "--misalignment-stddev", "5")


def test_a_night_is_drawn_and_solved_without_posix(tmp_path):
    folder = tmp_path / "Müllers Nächte" / "Ostern 2026"
    surroundings = os.environ | {"PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0"}

    def starpos(*args):
        done = subprocess.run(
            [sys.executable, "-c", LIKE_WINDOWS, *args], env=surroundings, capture_output=True, check=False
        )
        assert done.returncode == 0, done.stderr.decode("cp1252")
        return done.stdout.decode("cp1252")

    starpos("simulate", folder, "-n", "2", "--stars-only")
    out = starpos("solve", folder, *KNOWN, "--jobs", "2", "-o", tmp_path / "plätze.gpx")
    assert out.count("Müllers Nächte") == 3 and (tmp_path / "plätze.gpx").is_file()

# SPDX-License-Identifier: Apache-2.0
"""The executables `record`, which writes a night as a rosbag2, and `folder`, which writes it as a night's folder."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.cli.commands import Command
from starpos.errors import BagError
from starpos.files import rows_of
from starpos_bringup.bag import BagWriter

if TYPE_CHECKING:
    from starpos_bringup.recorder import FolderWriter, Recorder

DATA = Path(__file__).with_name("data")
# Exit statuses.
SAVED, BROKEN_OFF, REFUSED = 0, 1, 2


def record() -> int:
    from starpos_common.node_main import own_arguments, run

    options = parser_of("record").parse_args(own_arguments(sys.argv[1:])[0])
    rows = rows_of(DATA / "recorded.yaml")
    topics = {name: row for name, row in rows.items() if options.images or not row.get("images")}
    try:
        writer = BagWriter(options.bag)
    except BagError as error:
        say(str(error))
        return REFUSED
    recorders: list[Recorder] = []

    def make_nodes() -> "Iterator[Recorder]":
        from starpos_bringup.recorder import Recorder

        recorders.append(Recorder(writer, topics, say))
        yield recorders[0]

    status = run(make_nodes)
    return status or (BROKEN_OFF if any(r.trouble for r in recorders) else SAVED)


def parser_of(executable: str) -> argparse.ArgumentParser:
    """The parser of an executable of this package, from its row."""
    row = rows_of(DATA / "executables.yaml")[executable]
    return Command(**row).define(argparse.ArgumentParser(prog=executable))


def say(sentence: str) -> None:
    print(f"record: {' '.join(sentence.split())}", file=sys.stderr, flush=True)


def folder() -> int:
    from starpos_common.node_main import own_arguments, run

    path = parser_of("folder").parse_args(own_arguments(sys.argv[1:])[0]).folder
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"folder: {path}: it cannot be made ({error.strerror})", file=sys.stderr)
        return REFUSED

    def make_nodes() -> "Iterator[FolderWriter]":
        from starpos_bringup.recorder import FolderWriter

        yield FolderWriter(path)

    return run(make_nodes)

# SPDX-License-Identifier: Apache-2.0
"""YAML files that hold a calibration: whoever reads them checks the content; they are written whole or not at all."""

from pathlib import Path
from typing import Any

from starpos import files
from starpos.errors import InstrumentError, one_line

# Ten times what a calibration needs. A parser of YAML reads about 100 kB in a second.
MOST_BYTES = 64_000


def load(path: Path, what: str) -> Any:
    """Read the content of a file, which may be of any kind; InstrumentError if it cannot be read as `what`."""
    try:
        text = files.read_regular(path, MOST_BYTES)
    except OSError as e:
        raise InstrumentError(f"{path}: not a readable {what} ({e.strerror})") from None
    return parse(text, f"{path}: not a readable {what}")


def parse(text: bytes | str, complaint: str) -> Any:
    """Read YAML without aliases or keys given twice; InstrumentError that begins with the complaint if it is none."""
    import yaml

    class Loader(yaml.SafeLoader):
        """Reads YAML without aliases, a few lines of which unpack to gigabytes, and without keys that are given twice."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                line = self.peek_event().start_mark.line + 1
                raise InstrumentError(
                    f"{complaint} (line {line} has an alias, *name: write what it stands for)"
                )
            return super().compose_node(parent, index)

        def compose_mapping_node(self, anchor: Any) -> Any:
            node = super().compose_mapping_node(anchor)
            known = set()
            # a list or a mapping for a key is refused when it is read
            for key in (key for key, _ in node.value if isinstance(key.value, str)):
                if (key.tag, key.value) in known:
                    line = key.start_mark.line + 1
                    raise InstrumentError(
                        f"{complaint} (line {line} gives {one_line(key.value)} again: keep one of the two)"
                    )
                known.add((key.tag, key.value))
            return node

    try:
        return yaml.load(text, Loader)
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, yaml.YAMLError) as e:
        # what PyYAML is seen to raise
        mark = getattr(e, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise InstrumentError(f"{complaint} (it is no YAML{where})") from None


def save(path: Path, content: dict, comment: str = "") -> None:
    """Write a file whole or not at all (`files.write_whole`); InstrumentError if it cannot be written.

    comment is text for people, written at its end.
    """
    import yaml

    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    text += "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    try:
        files.write_whole(path, text.encode())
    # ValueError: the name contains a NUL
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InstrumentError(f"{path}: the file cannot be written there ({reason})") from None

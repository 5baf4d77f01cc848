# SPDX-License-Identifier: Apache-2.0
"""YAML files that hold a calibration: the reader checks the content; they are written whole or not at all."""

import hashlib
import re
from pathlib import Path
from typing import Any

from starpos import files
from starpos.errors import InstrumentError, one_line

# Ten times what a calibration needs. A parser of YAML reads about 100 kB in a second.
MAX_BYTES = 64_000
# The line above the comment that `save` writes, with the digest of that comment, and the lines of that.
BY_STARPOS = re.compile(r"^# by starpos, ([0-9a-f]{8}):\n((?:#.*\n)+)", re.MULTILINE)


def load(path: Path, what: str) -> Any:
    """Read the content of a file, which may be of any kind; InstrumentError if it cannot be read as `what`."""
    return parse(_bytes_at(path, what), f"{path}: not a readable {what}")


def text_at(path: Path, what: str) -> str:
    """Read the text of a file; InstrumentError as `load` raises it, and if it is not UTF-8."""
    try:
        return _bytes_at(path, what).decode()
    except UnicodeDecodeError:
        raise InstrumentError(f"{path}: not a readable {what} (it is no UTF-8)") from None


def _bytes_at(path: Path, what: str) -> bytes:
    try:
        return files.read_regular(path, MAX_BYTES)
    except OSError as e:
        raise InstrumentError(f"{path}: not a readable {what} ({e.strerror})") from None


def parse(text: bytes | str, complaint: str) -> Any:
    """Read YAML without aliases or keys given twice; InstrumentError that begins with the complaint if it is not."""
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
    """Write a file whole or not at all (`files.save`); InstrumentError if it cannot be written.

    comment is text for people, written at its end.
    """
    files.save(path, text_of(content, comment).encode(), error=InstrumentError)


def text_of(content: dict, comment: str = "") -> str:
    """The text that `save` writes."""
    import yaml

    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    return text + (f"# by starpos, {_digest(lines)}:\n{lines}" if lines else "")


def own_comment(text: str) -> str:
    """The comment of a file's text that `save` wrote, if it is unchanged; '' without one."""
    found = BY_STARPOS.search(text)
    if found is None or _digest(found[2]) != found[1]:
        return ""
    return "".join(line[1:].removeprefix(" ") for line in found[2].splitlines(keepends=True))


def line_of_comment(text: str) -> int:
    """The first line, from 1, of a file's YAML that has a comment of a person; 0 without one."""
    import yaml

    if own_comment(text):
        # keep the number of lines
        text = BY_STARPOS.sub(lambda found: "\n" * found[0].count("\n"), text, count=1)
    end = 0
    for token in yaml.scan(text, yaml.SafeLoader):
        begin = token.start_mark.index
        if isinstance(token, yaml.ScalarToken) and token.style not in ("|", ">"):
            if "#" in text[end:begin]:
                break
            end = token.end_mark.index
    else:
        begin = len(text)
    at = text.find("#", end, begin)
    return 0 if at < 0 else text.count("\n", 0, at) + 1


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]

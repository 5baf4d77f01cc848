# SPDX-License-Identifier: Apache-2.0
"""YAML files that hold a calibration: whoever reads them checks the content; they are written whole or not at all."""

import os
import tempfile
from pathlib import Path
from typing import Any

from starpos.errors import InstrumentError

SIZE_LIMIT = 1 << 20


def load(path: Path, what: str) -> Any:
    """Read the content of a file, which may be of any kind; InstrumentError if it cannot be read as `what`."""
    import yaml

    try:
        # reading a pipe would wait
        if path.exists() and not path.is_file():
            raise InstrumentError(f"{path}: not a readable {what} (it is no regular file)")
        with path.open("rb") as file:
            text = file.read(SIZE_LIMIT + 1)
        if len(text) > SIZE_LIMIT:
            raise InstrumentError(f"{path}: over 1 MiB, no {what}")
        return yaml.safe_load(text)
    except OSError as e:
        raise InstrumentError(f"{path}: not a readable {what} ({e.strerror})") from None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, yaml.YAMLError) as e:
        # what PyYAML is seen to raise
        mark = getattr(e, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise InstrumentError(f"{path}: not a readable {what} (it is no YAML{where})") from None


def save(path: Path, content: dict, comment: str = "") -> None:
    """Write a file so that at any moment, even after a power cut, either the old or the new one is there, whole.

    comment is text for people, written at its end. InstrumentError if the file cannot be written.
    """
    import yaml

    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    text += "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with open(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes a file that only its owner may read
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
        temporary = None
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    # ValueError: the name contains a NUL
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InstrumentError(f"{path}: the file cannot be written there ({reason})") from None
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)

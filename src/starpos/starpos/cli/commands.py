# SPDX-License-Identifier: Apache-2.0
"""The commands and their options: a file data/COMMAND.yaml for each, and groups of options of data/options.yaml."""

import argparse
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starpos.cli import COMMANDS
from starpos.errors import StarposError
from starpos.files import rows_of

DATA = Path(__file__).with_name("data")


class CallError(StarposError):
    """The options of a call do not go together."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command, or a kind of it: a file of rows, whose keys are these names.

    text         for --help; it begins with a small letter and has no full stop
    description  for its own --help, if it is more than the text
    epilog       what stands below its options
    examples, next_step   the end of its --help
    options      rows as `add_options` takes them
    kinds        commands of its own, of which a call names one
    """

    text: str
    description: str = ""
    epilog: str = ""
    examples: tuple[str, ...] = ()
    next_step: str = ""
    options: Mapping[str, dict | None] = field(default_factory=dict)
    kinds: Mapping[str, dict] = field(default_factory=dict)

    def define(self, parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
        """Add its options, and return the parser."""
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
        parser.description = self.description or f"{self.text[0].upper()}{self.text[1:]}."
        examples = "".join(f"  {example}\n" for example in self.examples)
        ends = self.epilog, examples and f"examples:\n{examples}\nnext: {self.next_step}"
        parser.epilog = "\n\n".join(filter(None, ends))
        add_options(parser, self.options)
        if self.kinds:
            kinds = parser.add_subparsers(dest="kind", required=True, metavar="|".join(self.kinds))
            for name, row in self.kinds.items():
                kind = Command(**row)
                kind.define(kinds.add_parser(name, help=kind.text))
        return parser


def check_call(args: argparse.Namespace) -> None:
    """Raise CallError if the options of a call do not go together."""
    command = command_of(args.command)
    kind = getattr(args, "kind", None)
    check_options(command.options if kind is None else command.kinds[kind]["options"], args)


def command_of(name: str) -> Command:
    """The command of a name."""
    return Command(text=COMMANDS[name], **rows_of(DATA / f"{name}.yaml"))


def add_options(parser: argparse.ArgumentParser, rows: Mapping[str, dict | None]) -> None:
    """Add options to a parser, each from a row; a name without a row is a group of options.yaml.

    The keys of a row are what argparse calls them (help, metavar, nargs, choices, default, const, required), and

    kind    text, the default; number (float), whole (int), degrees, path, flag (no value), several (may be given again)
    minimum, maximum   inclusive bounds of a number
    words   words that may stand for a number, with the value of each
    one_of  name of the set of options of which a call may give one, or has to if one is required
    under   title in --help
    needs, apart   for `check_options`
    """
    sets: dict[str, Any] = {}
    for names, row in _unfolded(rows):
        about: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in row.items()
        }
        about.pop("needs", None)
        about.pop("apart", None)
        place: argparse._ActionsContainer = parser
        if "under" in about:
            title = about.pop("under")
            place = sets[title] = sets.get(title) or parser.add_argument_group(title)
        elif "one_of" in about:
            name, required = about.pop("one_of"), about.pop("required", False)
            place = sets[name] = sets.get(name) or parser.add_mutually_exclusive_group(required=required)
        kind = about.pop("kind", "text")
        if kind == "flag":
            about["action"] = "store_true"
        elif kind == "several":
            about |= {"action": "append", "default": []}
        elif kind != "text":
            allowed = {key: about.pop(key) for key in ("minimum", "maximum", "words") if key in about}
            about["type"] = OTHERS.get(kind) or number(NUMBERS[kind], **allowed)
        place.add_argument(*names.split(), **about)


def check_options(rows: Mapping[str, dict | None], args: argparse.Namespace) -> None:
    """Raise CallError for an option without the one that it `needs`, or with one from which it stays `apart`."""
    known = {names.split()[-1]: row for names, row in _unfolded(rows)}

    def given(name: str) -> bool:
        row = known[name]
        default = {"flag": False, "several": []}.get(row.get("kind", ""), row.get("default"))
        return getattr(args, name.lstrip("-").replace("-", "_")) not in (default, [])

    for name, row in known.items():
        if not given(name):
            continue
        if "needs" in row and not given(row["needs"]):
            raise CallError(f"{name} is for {row['needs']}: give both")
        for other in row.get("apart", ()):
            if other in known and given(other):
                raise CallError(f"{name} and {other} do not go together: give one of the two")


def _unfolded(rows: Mapping[str, dict | None]) -> Iterator[tuple[str, dict]]:
    for names, row in rows.items():
        if row is None:
            yield from _unfolded(rows_of(DATA / "options.yaml")[names])
        else:
            yield names, row


def number(
    kind: type[int] | type[float],
    minimum: float | None = None,
    maximum: float | None = None,
    words: Mapping[str, Any] | None = None,
) -> Callable[[str], Any]:
    """An argparse type: a number of a kind, within bounds if there are any, or one of some words."""

    def parse(text: str) -> Any:
        if words and text in words:
            return words[text]
        try:
            value = kind(text)
        except ValueError:
            if not words:
                raise
            what = "whole number" if kind is int else "number"
            raise argparse.ArgumentTypeError(
                f"{text!r} is neither a {what} nor {' nor '.join(words)}"
            ) from None
        if minimum is not None and maximum is not None and not minimum <= value <= maximum:
            raise argparse.ArgumentTypeError(f"{text} must lie between {minimum:g} and {maximum:g}")
        return value

    # the name that argparse prints
    parse.__name__ = kind.__name__
    return parse


def degrees(text: str) -> float:
    """An argparse type: degrees, or degrees, minutes and seconds as 47:06:00 and -33:52:10.4."""
    parts = re.fullmatch(r"([+-]?)(\d{1,3}):([0-5]?\d)(?::([0-5]?\d(?:\.\d*)?))?", text.strip())
    if parts is None:
        try:
            return float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"{text!r} is no angle: give deg, such as 47.1 or 47:06:00, south and west negative"
            ) from None
    value = int(parts[2]) + int(parts[3]) / 60 + float(parts[4] or 0) / 3600
    return -value if parts[1] == "-" else value


NUMBERS = {"number": float, "whole": int}
OTHERS: dict[str, Callable[[str], Any]] = {"degrees": degrees, "path": Path}

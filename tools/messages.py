# SPDX-License-Identifier: Apache-2.0
"""The messages of commands and nodes, from the code, for docs/reference/troubleshooting.md (see reference.py)."""

import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LIBRARY = "src/starpos/starpos"
NODES = (
    "starpos_camera",
    "starpos_inclinometer",
    "starpos_solver",
    "src/starpos_common",
    "src/starpos_bringup",
    "src/starpos_dashboard",
)
# Calls whose texts people read: diagnostics, warnings of nodes, remarks of commands.
SHOWN = {"Diagnosis", "ok", "note", "missing", "warning", "warn", "complain", "refuse", "_say", "failed"}
# A sentence has at least this number of words, and for each value this number: others are parts, or lines of results.
MIN_WORDS, MIN_WORDS_A_VALUE = 4, 1.5
GAP = "…"
WORD = re.compile(r"[A-Za-z]{2,}")
MARKUP = re.compile(r"<|&\w+;")
# The end of another message, or a line to type.
FRAGMENT = re.compile(rf"\W*{GAP}[,;]|[,;.]|(?:pip|sudo|export|of) ")
# What happened, in three words or more, and behind a colon or semicolon what to do.
PARTS = re.compile(r"^(?P<happened>(?:\S+ ){2,}?\S+?)(?:: |; )(?P<advice>.+)$", re.DOTALL)


class Message(NamedTuple):
    """A message; values that the program fills in are GAP."""

    happened: str
    advice: str


@cache
def modules(folder: str) -> dict[Path, ast.Module]:
    """The modules of a folder; compiled ones raise no errors of their own."""
    paths = sorted((ROOT / folder).rglob("*.py"))
    return {path: parsed(path) for path in paths if "test" not in path.parts}


@cache
def parsed(path: Path) -> ast.Module:
    """A file's tree."""
    return ast.parse(path.read_text(encoding="utf-8"))


def error_names() -> set[str]:
    """Names of StarposError and of all classes that inherit from it."""
    names, bases = {"StarposError"}, {}
    for folder in (LIBRARY, *NODES):
        for tree in modules(folder).values():
            for node in tree.body:
                if isinstance(node, ast.ClassDef):
                    bases[node.name] = {ast.unparse(base).split(".")[-1] for base in node.bases}
    while more := {name for name, of in bases.items() if of & names} - names:
        names |= more
    return names


def constants(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Names and texts of a module's own constants, such as the advice that several messages share."""
    for node in tree.body:
        match node:
            case ast.Assign([ast.Name(name)], value) if (
                name.isupper() and (text := text_of(value, {})) is not None
            ):
                yield name, text


def text_of(node: ast.expr, known: Mapping[str, str]) -> str | None:
    """A literal, or f-string with GAP for values that are not `known` constants; None for anything else."""
    match node:
        case ast.Constant(str(text)):
            return text
        case ast.JoinedStr(parts):
            return "".join(text_of(part, known) or "" for part in parts)
        case ast.FormattedValue(ast.Name(name) | ast.Attribute(_, name)):
            return known.get(name, GAP)
        case ast.FormattedValue():
            return GAP
    return None


def texts(node: ast.AST, known: Mapping[str, str]) -> Iterator[str]:
    """The texts in an expression, without the parts of f-strings and the descriptions of parameters."""
    match node:
        case ast.Call(ast.Name("Parameter")):
            return
        case ast.Constant() | ast.JoinedStr() if (text := text_of(node, known)) is not None:
            yield text
            return
    for child in ast.iter_child_nodes(node):
        yield from texts(child, known)


def shown(tree: ast.AST, errors: set[str], known: Mapping[str, str]) -> Iterator[str]:
    """Texts that are raised, reported or returned as a sentence."""
    for node in ast.walk(tree):
        match node:
            # an error of the caller's class is called `error`
            case ast.Raise(ast.Call(ast.Name(name) | ast.Attribute(_, name), arguments)) if name in errors:
                for argument in arguments:
                    yield from texts(argument, known)
            case ast.Call(ast.Name(name) | ast.Attribute(_, name), arguments) if name in SHOWN:
                for argument in arguments:
                    yield from texts(argument, known)
            # a function that words a message returns, or collects, what happened and what to do
            case ast.Return(ast.expr() as value) | ast.Call(ast.Attribute(_, "append"), [value]):
                yield from (text for text in texts(value, known) if PARTS.match(text) and ". " not in text)


def messages(trees: Iterable[ast.Module], errors: set[str], shared: Mapping[str, str]) -> list[Message]:
    """The messages of modules, each once, in alphabetical order; shared: constants of other modules."""
    found = set()
    for tree in trees:
        for text in shown(tree, errors, {**shared, **dict(constants(tree))}):
            # the place, such as a file, comes first
            plain = re.sub(rf"^{GAP}: ", "", " ".join(text.split())).rstrip(".")
            words = len(WORD.findall(plain))
            long_enough = words >= max(MIN_WORDS, MIN_WORDS_A_VALUE * plain.count(GAP))
            if long_enough and not MARKUP.search(plain) and not FRAGMENT.match(plain):
                parts = PARTS.match(plain)
                found.add(Message(parts["happened"], parts["advice"]) if parts else Message(plain, ""))
    return sorted(found, key=lambda message: (message.happened.lstrip(f"{GAP} ").lower(), message))


def about(package: Path) -> str:
    """First sentence of a package's docstring."""
    text = ast.get_docstring(parsed(package)) or ""
    return " ".join(text.split("\n\n")[0].split())


def cell(text: str) -> str:
    """A text as code in a table."""
    return f"`` {text} ``".replace("|", "\\|") if WORD.search(text) else ""


def page() -> str:
    """Markdown with a table for each room of the library and for each package of nodes."""
    errors = error_names() | {"error"}
    shared = dict(pair for tree in modules(LIBRARY).values() for pair in constants(tree))
    rooms = [path.parent for path in sorted((ROOT / LIBRARY).glob("*/__init__.py"))]
    packages = [ROOT / node / Path(node).name for node in NODES]
    made = []
    for folder in (ROOT / LIBRARY, *rooms, *packages):
        trees = modules(str(folder.relative_to(ROOT)))
        if folder == ROOT / LIBRARY:
            trees = {path: tree for path, tree in trees.items() if path.parent == folder}
        if found := messages(trees.values(), errors, shared):
            made += [f"\n## {folder.name}\n", about(folder / "__init__.py"), ""]
            made += ["| what happened | what it means, what to do |", "| --- | --- |"]
            made += [f"| {cell(message.happened)} | {cell(message.advice)} |" for message in found]
    return "\n".join(made) + "\n"

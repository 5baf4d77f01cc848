# SPDX-License-Identifier: Apache-2.0
"""Find riddles, long sentences and American spelling in documents, definitions of messages, docstrings and comments.

`words.py [FILE ...]` prints a line for each and exits 1 if it found any. Without arguments it reads all that READ
names. `words.py --count` prints how often each pattern occurs. `make lint` runs it.
"""

import ast
import inspect
import re
import sys
from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
# What is read.
READ = (
    "*.md",
    "docs/**/*.md",
    "test/*.md",
    "test/*.py",
    "starpos_*/test/*.py",
    "src/*/test/**/*.py",
    "tools/*.py",
    "tools/*/**/*.py",
    "starpos_*/*.md",
    "src/*/*.md",
    "starpos_interfaces/*/*.[ms][sr][gv]",
    "src/starpos/starpos/**/*.py",
    "src/starpos_bringup/starpos_bringup/**/*.py",
    "src/starpos_common/starpos_common/*.py",
    "src/starpos_dashboard/starpos_dashboard/*.py",
    "src/starpos_testing/starpos_testing/**/*.py",
    "starpos_camera/starpos_camera/**/*.py",
    "starpos_inclinometer/starpos_inclinometer/**/*.py",
    "starpos_solver/starpos_solver/*.py",
)
MAX_WORDS = 40
# Name of a pattern: its expression, and what to write instead.
RIDDLES = {
    "that of": (r"\bth(?:at|ose) of\b", "repeat the noun"),
    "is none": (r"\b(?:is|are|was|were) (?-i:none)\b", "say what is missing"),
    "tells": (r"\b(?:tells?|told)\b", "determines, gives, says or shows"),
    "beside": (r"\bbeside\b", "next to, besides or compared with"),
    "so many": (r"\bso many\b", "give the number or name the quantity"),
    "of each ... its": (r"\bof each\b[^.:;]{0,40}\bits\b", "each X has its Y"),
    "what ... that": (r"\bwhat\b[^.,:;|]{0,40}\bthat\b", "name the thing"),
    "want of": (r"\bwant of\b", "lack of"),
    "nobody": (r"\bnobody\b", "unknown, unset or not stated"),
}
AMERICAN = {
    r"colors?|colored": "colour",
    r"gray": "grey",
    r"(?:centi|milli|kilo)?meters?": "metre",
    r"centers?|centered": "centre",
    r"neighbors?|neighboring": "neighbour",
    r"behavior": "behaviour",
    r"favor\w*": "favour",
    r"catalogs?": "catalogue",
    r"licenses": "licences",
    r"modeled|modeling": "modelled",
    r"labeled|canceled|leveled": "two letters l",
    r"analyz\w+": "analyse",
    # not size, prize, seize, Ritz
    r"\w{3,}(?:al|an|et|ct|ch|mm|n|gn|im|ar|il|t|er|in)iz(?:e|es|ed|ing|ation)": "-ise",
}
PATTERNS = [
    *((name, re.compile(wrong, re.IGNORECASE), advice) for name, (wrong, advice) in RIDDLES.items()),
    *(
        ("spelling", re.compile(rf"\b(?:{wrong})\b", re.IGNORECASE), advice)
        for wrong, advice in AMERICAN.items()
    ),
]
# Generated tables, comments and code of Markdown, which are left out.
LEFT_OUT = re.compile(
    r"<!-- table -->.*?<!-- end of table -->|<!--.*?-->|^ *```.*?^ *```$|^(?: {4}|\t)[^\n]*(?=\n)",
    re.DOTALL | re.MULTILINE,
)
# What a program reads or prints, and addresses, are quoted as they are.
QUOTED = re.compile(r"`[^`]*`|(?<=\])\([^)\s]*\)|<[^>\s]*>|\"[^\"]*\"|\w*_\w*")
SENTENCE_END = re.compile(r"(?<=[.?!])[\"')*]*\s+(?=[^\w`]*[A-Z0-9`])")
# Between paragraphs of a docstring, and before the description of an argument or a field.
PARAGRAPH = re.compile(
    r"\n\s*\n|\n(?=[ \w,*]+(?:  |: ))|(?<=\S)  +(?=\S)"
    r"|(?<=\.)\s(?=[\w, ]+(?: \([^)]*\))?(?: in [\w.]+)?: )"
)
# A comment, in the first group, or a string, which may hold a hash: Python's own tokens take ten times as long.
COMMENT = re.compile(
    r"""(\#[^\n]*)|\"{3}(?:\\.|[^\\])*?\"{3}|'{3}(?:\\.|[^\\])*?'{3}|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'""",
    re.DOTALL,
)
BLOCK = re.compile(r"\s*(?:[-*+] |\d+\. |#|\||>|: |```|$)")


class Breach(NamedTuple):
    line: int
    name: str
    words: str
    advice: str


def blocks(markdown: str) -> Iterator[tuple[int, str]]:
    """Paragraphs, items, headings and table cells with the line on which each begins."""
    blank = LEFT_OUT.sub(lambda found: "\n" * found.group().count("\n"), markdown)
    begun, gathered = 0, ""
    for number, line in enumerate([*blank.splitlines(), ""], 1):
        if BLOCK.match(line):
            if gathered:
                yield begun, gathered
            gathered = ""
        if line.lstrip().startswith("|"):
            yield from ((number, cell) for cell in line.split("|"))
        else:
            begun, gathered = begun if gathered else number, f"{gathered} {line.strip()}".strip()


def comments(definition: str) -> Iterator[tuple[int, str]]:
    """Comments of a message's or service's definition; those on successive lines of their own are one."""
    begun, gathered = 0, ""
    for number, line in enumerate([*definition.splitlines(), ""], 1):
        code, _, comment = line.partition("#")
        if gathered and (code.strip() or not comment.strip()):
            yield begun, gathered
            gathered = ""
        if code.strip():
            yield number, comment.strip()
        elif comment.strip():
            begun, gathered = begun if gathered else number, f"{gathered} {comment.strip()}".strip()


def said(source: str) -> Iterator[tuple[int, str]]:
    """Paragraphs of docstrings, and comments; those on successive lines are one."""
    left: deque[ast.AST] = deque([ast.parse(source)])
    while left:
        node = left.popleft()
        match node:
            case ast.Expr(ast.Constant(str(text))):
                for paragraph in PARAGRAPH.split(inspect.cleandoc(text)):
                    yield node.lineno, " ".join(paragraph.split())
        # no expression holds a statement
        left.extend(child for child in ast.iter_child_nodes(node) if not isinstance(child, ast.expr))
    begun, last, gathered = 0, 0, ""
    number, counted = 1, 0
    for found in COMMENT.finditer(source):
        if found[1]:
            number, counted = number + source.count("\n", counted, found.start()), found.start()
            if gathered and number != last + 1:
                yield begun, gathered
                gathered = ""
            begun, last = begun if gathered else number, number
            gathered = f"{gathered} {found[1].lstrip('# ')}".strip()
    yield begun, gathered


READERS = {".md": blocks, ".msg": comments, ".srv": comments, ".py": said}


def breaches(text: str, suffix: str) -> Iterator[Breach]:
    """All breaches in the text of a file, in reading order."""
    for line, block in READERS[suffix](text):
        plain = QUOTED.sub(lambda quoted: "" if quoted.group().startswith("(") else "X", block)
        for name, wrong, advice in PATTERNS:
            yield from (Breach(line, name, found.group(), advice) for found in wrong.finditer(plain))
        for sentence in SENTENCE_END.split(plain):
            words = [word for word in sentence.split() if re.search(r"\w", word)]
            if len(words) > MAX_WORDS:
                start = " ".join(words[:6])
                yield Breach(line, "long", f"{len(words)} words: {start} ...", "one idea a sentence")


def main(arguments: list[str]) -> int:
    counting = "--count" in arguments
    named = [Path(argument) for argument in arguments if argument != "--count"]
    files = named or sorted({path.relative_to(ROOT) for pattern in READ for path in ROOT.glob(pattern)})
    texts = {file: (ROOT / file).read_text(encoding="utf-8") for file in files}
    found = [(file, breach) for file, text in texts.items() for breach in breaches(text, file.suffix)]
    if counting:
        for name, count in Counter(breach.name for _, breach in found).most_common():
            print(f"{count:5} {name}")
    else:
        for file, breach in found:
            print(f"{file}:{breach.line}: {breach.name}: {breach.words} ({breach.advice})")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

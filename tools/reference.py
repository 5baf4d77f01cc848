# SPDX-License-Identifier: Apache-2.0
"""Write the reference pages that are made from the code: parameters, messages and services, troubleshooting.

    python tools/reference.py [--check]

Each page keeps what stands above its mark; a page without the mark is an error. With --check nothing is written, and
pages that differ from what the code makes are named (exit status 1).
"""

import re
import sys
from pathlib import Path

import messages

ROOT = Path(__file__).resolve().parents[1]
INTERFACES = ROOT / "starpos_interfaces"
PARAMETERS = ROOT / "src" / "starpos_bringup" / "config" / "starpos.yaml"
MARK = "<!-- from here on made by tools/reference.py -->\n"


def about_parameters() -> str:
    """Tables of all parameters, from the comments of starpos.yaml, which is made from the nodes' own tables."""
    made: list[str] = []
    said: list[str] = []
    for line in PARAMETERS.read_text().splitlines():
        if node := re.match(r"/\*\*/(\w+):", line):
            made += [f"\n## {node[1]}\n", "| parameter | what it is |", "| --- | --- |"]
            said = []
        elif line.startswith("    # "):
            said.append(line[6:].replace("|", "\\|"))
        elif value := re.match(r"    ([\w./]+): (.*)", line):
            default = "unset" if value[2] == ".nan" else value[2]
            made.append(f"| `{value[1]}` | {' '.join(said)} Default: `{default}`. |")
            said = []
    return "\n".join(made) + "\n"


def about_messages() -> str:
    """The definitions of messages and services, which say of each field what it is."""
    files = [*sorted(INTERFACES.glob("msg/*.msg")), *sorted(INTERFACES.glob("srv/*.srv"))]
    about = ((f.stem, f.read_text().split("\n", 1)[1].strip()) for f in files)
    return "".join(f"\n## {name}\n\n```\n{text}\n```\n" for name, text in about)


PAGES = {
    "parameters": about_parameters,
    "messages": about_messages,
    "troubleshooting": messages.page,
}


def pages() -> dict[Path, str]:
    """Text of each page as the code makes it."""
    made = {}
    for name, make in PAGES.items():
        path = ROOT / "docs" / "reference" / f"{name}.md"
        made[path] = above_the_mark(path) + MARK + make()
    return made


def above_the_mark(path: Path) -> str:
    """The part of a page that is written by hand; ends the program if the mark is missing, or is there twice."""
    parts = path.read_text(encoding="utf-8").split(MARK)
    if len(parts) != 2:
        sys.exit(
            f"{path}: this line must be there once, and is there {len(parts) - 1} times: {MARK.strip()}. "
            "Put it below what is written by hand, and run python tools/reference.py again."
        )
    return parts[0]


def main() -> int:
    old = {path: text for path, text in pages().items() if path.read_text(encoding="utf-8") != text}
    if sys.argv[1:] == ["--check"]:
        for path in old:
            print(f"{path.relative_to(ROOT)}: not what the code makes: python tools/reference.py writes it")
        return bool(old)
    for path, text in old.items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

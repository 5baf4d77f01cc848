# SPDX-License-Identifier: Apache-2.0
"""Write what is made from the code: starpos.yaml and its reference page, messages and services, troubleshooting.

    python tools/reference.py [--check]

Each page keeps what stands above its mark; a page without the mark is an error. With --check nothing is written, and
pages that differ from what the code makes are named (exit status 1).
"""

import sys
from pathlib import Path

import messages

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src" / "starpos"))

from starpos.parameters.table import NODES, parameters_of, yaml_value  # noqa: E402

INTERFACES = ROOT / "starpos_interfaces"
PARAMETERS = ROOT / "src" / "starpos_bringup" / "config" / "starpos.yaml"
MARK = "<!-- from here on made by tools/reference.py -->\n"


def about_parameters() -> str:
    """Tables of all parameters, from the rows that the nodes read."""
    made: list[str] = []
    for node in NODES:
        made += [f"\n## {node}\n", "| parameter | what it is |", "| --- | --- |"]
        for p in parameters_of(node):
            said = f"{p.description} {p.rule}".replace("|", "\\|")
            value = yaml_value(p.default)
            made.append(f"| `{p.name}` | {said} Default: `{'unset' if value == '.nan' else value}`. |")
    return "\n".join(made) + "\n"


def parameter_file() -> str:
    """ROS's parameter file of all nodes: every parameter at its default, below its meaning, unit and constraint."""
    # REUSE-IgnoreStart
    lines = ["# SPDX-License-Identifier: Apache-2.0"]
    # REUSE-IgnoreEnd
    lines.append("# All parameters at their defaults; keep what you change. Written by tools/reference.py.")
    for node in NODES:
        lines += ["", f"/**/{node}:", "  ros__parameters:"]
        for p in parameters_of(node):
            lines += [f"    # {p.description}", f"    # {p.rule}", f"    {p.name}: {yaml_value(p.default)}"]
    return "\n".join(lines) + "\n"


def about_messages() -> str:
    """The definitions of messages and services, which say of each field what it is."""
    files = [*sorted(INTERFACES.glob("msg/*.msg")), *sorted(INTERFACES.glob("srv/*.srv"))]
    about = ((f.stem, f.read_text().split("\n", 1)[1].strip()) for f in files)
    return "".join(f"\n## {name}\n\n```\n{text}\n```\n" for name, text in about)


PAGES = {"parameters": about_parameters, "messages": about_messages, "troubleshooting": messages.page}


def pages() -> dict[Path, str]:
    """Text of each page as the code makes it, and of the parameter file that is installed."""
    made = {PARAMETERS: parameter_file()}
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

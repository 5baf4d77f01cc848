# SPDX-License-Identifier: Apache-2.0
"""What the documents name is there: links, headings, files, tools, parameters."""

import ast
import importlib
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = sorted(p.parent for p in (*ROOT.glob("*/package.xml"), *ROOT.glob("src/*/package.xml")))
DOCUMENTS = sorted(
    {d for folder in (ROOT, ROOT / "test", *PACKAGES) for d in folder.glob("*.md")}
    | set((ROOT / "docs").glob("**/*.md"))
)
OF_NODES = {
    "camera": "starpos_camera",
    "dashboard": "src/starpos_dashboard",
    "detector": "starpos_camera",
    "inclinometer": "starpos_inclinometer",
    "navigator": "starpos_solver",
    "solver": "starpos_solver",
}
ROOMS = (ROOT / "docs", ROOT / "test", ROOT / "tools", *PACKAGES)
FILES = sorted(f for f in (*ROOT.glob("*.*"), *(g for r in ROOMS for g in r.rglob("*"))) if f.is_file())
CYTHON = (".pyx", ".pxd")
MODULES = {p.name: p / p.name for p in PACKAGES}
# but what Cython has written
SOURCES = [
    f
    for f in FILES
    if f.suffix in (".py", ".h", *CYTHON) or (f.suffix == ".c" and MODULES["starpos"] not in f.parents)
]
FILE_ENDINGS = {"json", "md", "py", "rviz", "yaml"}
# Names of the C library, of ERFA, of avr-libc.
FOREIGN = {"sys/timex.h", "t_erfa_c.c", "util/crc16.h"}
SHOUTED = r"\b(?:ARCHITECTURE|CONTRIBUTING|DESIGN|ERRATA|PROTOCOL|README|TUTORIAL)\b(?:\.md)?"
NAMED = re.compile(rf"{SHOUTED}|(?<![\w./-])[\w./-]*\w\.(?:md|rst|py|pyx|pxd|c|h|svg)\b(?:#[\w-]+)?")
DOTTED = re.compile(r"(?<![\w./-])(starpos(?:_[a-z]+)?)((?:\.[A-Za-z_]\w*)+)")


def headings(document: Path) -> set[str]:
    """The headings, as GitHub makes anchors of them."""
    found = re.findall(r"^#+ (.*)$", document.read_text(), re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", h).replace("`", "").strip().lower() for h in found)
    return {re.sub(r"[^\w\- ]", "", h).replace(" ", "-") for h in plain}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda d: str(d.relative_to(ROOT)))
def test_every_link_and_every_tool_that_is_named_is_there(document):
    text = document.read_text()
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = document.parent / path if path else document
        assert target.exists(), link
        assert not anchor or anchor in headings(target), link
    for tool in re.findall(r"\b(?:tools|test)/(?:\w+/)*\w+\.\w+", text):
        assert any((folder / tool).exists() for folder in (ROOT, document.parent, *PACKAGES)), tool


def test_the_architecture_names_every_folder_of_starpos():
    [_, section] = (ROOT / "docs" / "architecture.md").read_text().split("## Folders of starpos\n", 1)
    folders = {p.parent.name for p in MODULES["starpos"].glob("*/__init__.py")}
    assert folders and {name for name in folders if f"`{name}`" not in section} == set()


def test_pages_of_the_reference_are_what_the_code_makes():
    tool = [sys.executable, ROOT / "tools" / "reference.py", "--check"]
    done = subprocess.run(tool, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


@pytest.mark.parametrize("marks", [0, 2])
def test_a_page_of_the_reference_without_its_mark_is_an_error_and_is_left_alone(marks, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    reference = importlib.import_module("reference")
    page = tmp_path / "parameters.md"
    page.write_text("# By hand\n" + marks * f"{reference.MARK}Table\n")
    with pytest.raises(SystemExit, match=f"must be there once, and is there {marks} times"):
        reference.above_the_mark(page)


def test_the_readme_is_short():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 120


def test_the_readme_is_read_with_ease():
    """Its prose, without tables, code and pictures: words a sentence."""
    text = re.sub(r"```.*?```", "", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    prose = re.sub(r"^(?:    |\||#|!).*$", "", text, flags=re.MULTILINE)
    prose = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", prose)
    paragraphs = re.split(r"\n\s*\n|\n- ", prose)
    sentences = [s for p in paragraphs for s in re.split(r"(?<=[.?!])\s+", p) if s.strip()]
    long = [s for s in sentences if len(s.split()) > 35]
    assert not long and len(prose.split()) < 18 * len(sentences)


def test_the_readme_says_what_a_newcomer_asks_first():
    text = (ROOT / "README.md").read_text()
    asked = ("**Status**", "never run on hardware", "## How accurate", "## What it is not for", "(**A3**)")
    assert [words for words in asked if words not in text] == []
    assert [page for page in ("parts", "install", "calibrate") if f"docs/how-to/{page}.md" not in text] == []


def test_every_page_is_in_the_sites_table_of_contents():
    """A page that is in none is a warning of Sphinx, which is a failure; this says so without Sphinx."""
    folder = ROOT / "docs"
    named = re.findall(r"^(?:\.\./)?[\w/.-]+$", (folder / "index.md").read_text(), re.MULTILINE)
    pages = {p.relative_to(folder).with_suffix("").as_posix() for p in folder.glob("**/*.md")} - {"index"}
    assert pages - set(named) == set()
    assert all(any((folder / f"{name}{end}").is_file() for end in (".md", ".rst")) for name in named)


def test_every_parameter_is_in_its_packages_readme():
    nodes = yaml.safe_load((ROOT / "src" / "starpos_bringup" / "config" / "starpos.yaml").read_text())
    for name, node in nodes.items():
        name = name.rsplit("/", 1)[-1]
        readme = (ROOT / OF_NODES[name] / "README.md").read_text()
        missing = [p for p in flat(node["ros__parameters"]) if f"`{p}`" not in readme]
        assert not missing, name


def flat(parameters: dict, before: str = ""):
    for name, value in parameters.items():
        if isinstance(value, dict):
            yield from flat(value, f"{before}{name}.")
        else:
            yield before + name


@pytest.mark.parametrize("package", [None, *PACKAGES], ids=lambda p: p.name if p else "test and tools")
def test_what_comments_and_docstrings_name_is_there(package):
    """Files, documents with their headings, modules and what is in them; a comment is written once and read for years."""
    folders = [package] if package else [ROOT / "test", ROOT / "tools"]
    wrong = [
        f"{source.relative_to(ROOT)}: {name}"
        for source in SOURCES
        if any(folder in source.parents for folder in folders)
        for text in said_beside_the_code(source)
        for name in not_there(text, source)
    ]
    assert not wrong


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda d: str(d.relative_to(ROOT)))
def test_every_module_and_source_file_that_a_document_names_is_there(document):
    text = document.read_text()
    assert not [m.group() for m in DOTTED.finditer(text) if not is_module(*m.groups())]
    assert not [f for f in re.findall(r"(?<![\w./-])[\w/]+\.(?:py|c|h)\b", text) if not is_file(f, document)]
    assert not [f for f in re.findall(r"(?<![\w./-])src/[\w./-]*\w", text) if not (ROOT / f).exists()]


@pytest.mark.parametrize(
    "said",
    [
        # a document that is not in the repository
        "see DESIGN section 2",
        "as ARCHITECTURE.md says",
        "docs/nowhere.md",
        "docs/the_paper.md#no-such-heading",
        "see tools/nowhere.py",
        "turned by nowhere.py",
        "starpos.nowhere",
        "starpos.rotation.nowhere",
    ],
)
def test_what_is_not_there_is_found(said):
    assert not_there(said, ROOT / "src" / "starpos" / "starpos" / "rotation.py")


def test_what_compiled_modules_name_is_read(tmp_path):
    source = tmp_path / "new.pyx"
    source.write_text('x = 1  # see nowhere.py\ndef f():\n    """As starpos.nowhere\n    # says."""\n')
    assert [not_there(text, source) for text in said_beside_the_code(source)] == [
        ["nowhere.py"],
        ["starpos.nowhere"],
    ]


def said_beside_the_code(source: Path) -> list[str]:
    """Comments and docstrings."""
    text = source.read_text()
    if source.suffix in CYTHON:
        return re.findall(r'""".*?"""|#[^\n]*', text, re.DOTALL)
    if source.suffix != ".py":
        return re.findall(r"//.*|/\*.*?\*/", text, re.DOTALL if "/*" in text else 0)
    comments = [
        t.string for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type == tokenize.COMMENT
    ]
    docstrings = (ast.get_docstring(node) for node in with_docstrings(ast.parse(text)))
    return [*comments, *filter(None, docstrings)]


def with_docstrings(node: ast.AST):
    """Modules, classes and functions; no expression holds any."""
    if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
        yield node
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.expr):
            yield from with_docstrings(child)


def not_there(text: str, source: Path) -> list[str]:
    """What a comment of `source` names and the repository does not hold."""
    files = [name for name in NAMED.findall(text) if not is_file(name, source)]
    modules = [m.group() for m in DOTTED.finditer(text) if not is_module(*m.groups())]
    return files + [m for m in modules if m not in files]


def is_file(name: str, source: Path) -> bool:
    """Any file of the repository whose path ends so; a README only one of a folder that `source` lies in."""
    if name in FOREIGN:
        return True
    path, _, anchor = name.partition("#")
    path = path if "." in path else f"{path}.md"
    if path == "README.md":
        found = [folder / path for folder in source.parents if ROOT in (folder, *folder.parents)]
    else:
        found = [f for f in FILES if f.as_posix().endswith(f"/{path.lstrip('./')}")]
    return any(f.exists() and (not anchor or anchor in headings(f)) for f in found)


def is_module(package: str, names: str) -> bool:
    """Whether `package` has this module, and the module these names; file names and topics have dots too, and pass."""
    place, parts = MODULES.get(package), names.split(".")[1:]
    if place is None or not place.is_dir() or parts[-1] in FILE_ENDINGS:
        return True
    while parts and (place / parts[0]).is_dir():
        place = place / parts.pop(0)
    files = [place / f"{parts[0]}{ending}" for ending in (".py", ".pyx")] if parts else []
    if found := [file for file in files if file.is_file()]:
        place = found[0]
        del parts[0]
    # What a package offers it may have from elsewhere.
    if place.is_dir():
        stub = place / "__init__.pyi"
        offered = (place / "__init__.py").read_text() + (stub.read_text() if stub.is_file() else "")
        home = (
            re.search(rf"(?m)^from {place.name}\.([\w.]+) import {parts[0]} as", offered) if parts else None
        )
        if home and len(parts) > 1:
            return is_module(package, f".{home[1]}.{'.'.join(parts)}")
        return all(re.search(rf"\b{part}\b", offered) for part in parts)
    made = r"(?m)^ *(?:(?:def|class) {0}\b|{0}:|[\w, ]*\b{0}\b[\w, ]*(?::[^=\n]+)?=)"
    return all(re.search(made.format(part), place.read_text()) for part in parts)

# SPDX-License-Identifier: Apache-2.0
"""Check the rules of imports that import-linter cannot (tools/imports.ini): ROS, Cython; and a few rules of names.

`walls.py` prints a line for each breach and exits 1 where there is one. `make lint` runs it.
"""

import ast
import gc
import io
import re
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from configparser import ConfigParser
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# who may import whom, for import-linter; compiled modules keep to the same floors
CONTRACTS = ROOT / "tools" / "imports.ini"
# Modules that starpos may import besides Python's own: a closed list, because ROS has more names than one could list.
FOREIGN = {
    "argcomplete",
    "astropy",
    "astropy_iers_data",
    "cv2",
    "erfa",
    "exifread",
    "jplephem",
    "lz4",
    "matplotlib",
    "numpy",
    "pillow_heif",
    "rawpy",
    "rosbags",
    "scipy",
    "sgp4",
    "yaml",
}
# What compiled modules may import besides compiled modules of their own folder and of lower floor numbers.
OF_CYTHON = {"cpython", "libc", "numpy"}
IMPORTED = re.compile(r"\bfrom\s+([\w.]+)\s+c?import\b|\bc?import\s+(.+)")
# names that the whole field writes in this way
USUAL = {("numpy", "np"), ("xml.etree.ElementTree", "ET"), ("matplotlib.pyplot", "plt")}
DOCUMENTED = ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef
MAX_LINES = 900
# Words that begin no docstring: it begins with a verb or a noun, which "as many stars" is.
NO_BEGINNING = re.compile(
    r"(Of|The same|By|At which|As(?! many\b)|And|But|Also|In|With|Within|That|Those|Until|Under)\b"
)
# Directives of tools stand next to the code that they are about.
FOR_TOOLS = re.compile(r"# *(noqa|type:|fmt:|pragma)")
# What is no code in Cython. One expression: a comment may hold a quotation mark, and a string a hash.
CYTHON = re.compile(
    r"""(?P<long>\"{3}.*?\"{3})|(?P<comment>\#[^\n]*)|(?P<short>"[^"\n]*"|'[^'\n]*')""", re.DOTALL
)
# A dataclass of this number of fields is made by keyword, after three fields at most.
KEYWORD_FIELDS = 6


@dataclass(frozen=True)
class Module:
    """A Python file of the product: its dotted name, its file and what it says."""

    name: str
    path: Path
    text: str

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """All nodes of the tree, which many rules look through."""
        return list(ast.walk(self.tree))

    @property
    def package(self) -> str:
        return self.name.partition(".")[0]

    @property
    def folder(self) -> str:
        """The folder of `starpos` that it lies in, or its own name if it is a module of floor 0."""
        return self.name.split(".")[1] if "." in self.name else ""

    def at(self, node: ast.AST, sentence: str) -> str:
        return self.at_line(getattr(node, "lineno", 1), sentence)

    def at_line(self, line: int, sentence: str) -> str:
        return f"{self.path.relative_to(ROOT)}:{line}: {sentence}"

    def docstrings(self) -> Iterator[tuple[int, str]]:
        """Each docstring, and the line of what it documents."""
        for node in self.nodes:
            if isinstance(node, DOCUMENTED) and (said := ast.get_docstring(node)):
                yield getattr(node, "lineno", 1), said

    def functions(self) -> Iterator[str]:
        """The names of its functions."""
        yield from (node.name for node in self.tree.body if isinstance(node, ast.FunctionDef))

    def comments(self) -> Iterator[tuple[int, str, str]]:
        """Comments next to code, each with its line and that code."""
        # most files have none, and are not taken apart
        if not re.search(r"(?m)^[ \t]*[^\s#].*#", self.text):
            return
        for token in tokenize.generate_tokens(io.StringIO(self.text).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.line[: token.start[1]].strip(), token.string


@dataclass(frozen=True)
class Compiled(Module):
    """A file in Cython, which Python cannot parse: strings, comments and the code between them."""

    def parts(self, kind: str) -> Iterator[tuple[int, str, str]]:
        """All of a kind of `CYTHON`: its line, the code before it on that line, and itself."""
        for found in CYTHON.finditer(self.text):
            if found.lastgroup == kind:
                before = self.text[: found.start()]
                yield before.count("\n") + 1, before.rpartition("\n")[2].strip(), found.group()

    def docstrings(self) -> Iterator[tuple[int, str]]:
        """Each docstring and its line, but strings of C, which stand under `cdef extern`."""
        lines = self.text.splitlines()
        for line, before, said in self.parts("long"):
            if not before and not (line > 1 and lines[line - 2].lstrip().startswith("cdef extern")):
                yield line, said.strip('"').strip()

    def functions(self) -> Iterator[str]:
        """The names of its functions that Python sees."""
        yield from re.findall(r"(?m)^def (\w+)\(", self.code())

    def comments(self) -> Iterator[tuple[int, str, str]]:
        """Comments, each with its line and the code next to it."""
        yield from self.parts("comment")

    def imported(self) -> Iterator[tuple[int, str]]:
        """The line and the name of each module that it imports, in Python or in C."""
        for number, line in enumerate(self.code().splitlines(), 1):
            for home, names in IMPORTED.findall(line):
                for name in [home] if home else [part.split()[0] for part in names.split(",")]:
                    yield number, name

    def code(self) -> str:
        """The code without strings and comments, on its own lines."""
        return CYTHON.sub(lambda found: "\n" * found.group().count("\n"), self.text)


def packages() -> dict[str, Path]:
    """Each package of ours and the folder of its modules."""
    found = (p.parent for p in (*ROOT.glob("*/package.xml"), *ROOT.glob("src/*/package.xml")))
    return {folder.name: folder / folder.name for folder in sorted(found) if (folder / "setup.py").is_file()}


def modules() -> list[Module]:
    """All modules of the product."""
    found = []
    for package, folder in packages().items():
        for path in sorted(folder.rglob("*.py")):
            parts = [package, *path.relative_to(folder).with_suffix("").parts]
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            found.append(Module(name, path, path.read_text()))
    return found


def beside() -> list[Module]:
    """All tests, what they share, and the tools."""
    folders = (*ROOT.glob("*/test"), *ROOT.glob("src/*/test"), ROOT / "test", ROOT / "tools")
    paths = sorted({p for folder in folders for p in folder.rglob("*.py")})
    return [Module(path.stem, path, path.read_text()) for path in paths]


def compiled() -> list[Compiled]:
    """All files in Cython."""
    folder = packages()["starpos"]
    paths = sorted((*folder.glob("*/*.pyx"), *folder.glob("*/*.pxd")))
    return [Compiled(f"starpos.{path.parent.name}.{path.stem}", path, path.read_text()) for path in paths]


@cache
def floors() -> dict[str, int]:
    """The floor number of each folder of `starpos`; single modules (`errors`, `units` and others) have 0."""
    contracts = ConfigParser()
    contracts.read(CONTRACTS)
    lines = contracts["importlinter:contract:floors"]["layers"].split("\n")
    return {
        name: k
        for k, line in enumerate(reversed([line for line in lines if line]))
        for name in re.findall(r"\w+", line)
    }


def imports(module: Module) -> Iterator[tuple[ast.AST, str]]:
    """What it imports, and where."""
    for node in module.nodes:
        if isinstance(node, ast.Import):
            yield from ((node, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node, f"{node.module}.{alias.name}") for alias in node.names)


def outside(sources: list[Module]) -> Iterator[str]:
    """Imports of `starpos` that no contract sees: of ROS, and of the package itself, which imports all folders."""
    for module in sources:
        for node, target in imports(module) if module.package == "starpos" else ():
            package, _, rest = target.partition(".")
            if package not in {"starpos", *FOREIGN, *sys.stdlib_module_names}:
                yield module.at(
                    node, f"starpos imports {package}, which is ROS, or not yet in FOREIGN of walls.py"
                )
            elif package != "starpos" or rest == "__version__":
                continue
            elif rest.partition(".")[0] not in floors():
                yield module.at(
                    node, f"import of {target} brings in every folder: import the name from its own folder"
                )


def cimports(files: list[Compiled]) -> Iterator[str]:
    """Imports of compiled modules: of others in Cython only, in their own folder or one with a smaller floor number."""
    floor, root = floors(), packages()["starpos"]
    for file in files:
        for line, name in file.imported():
            package, folder, module = (*name.split("."), "", "")[:3]
            if package in OF_CYTHON:
                continue
            if package != "starpos" or not (root / folder / f"{module}.pxd").is_file():
                yield file.at_line(line, f"a compiled module imports {name}")
            elif folder != file.folder and floor[folder] >= floor[file.folder]:
                sentence = (
                    f"{file.folder} (floor {floor[file.folder]}) imports {folder} (floor {floor[folder]})"
                )
                yield file.at_line(line, sentence)


def uncalled(sources: list[Module]) -> Iterator[str]:
    """Compiled modules that nothing in their own folder calls; the modules of `_numeric` are shared on purpose."""
    called = set()
    for module in sources:
        if isinstance(module, Compiled):
            called |= {(module.folder, name) for _, name in module.imported()}
        else:
            called |= {(module.folder, target.rpartition(".")[0]) for _, target in imports(module)}
    for module in sources:
        if (
            isinstance(module, Compiled)
            and module.folder != "_numeric"
            and (module.folder, module.name) not in called
        ):
            yield module.at_line(1, f"nothing in {module.folder} calls it: put it where it is called")


def aliases(sources: list[Module]) -> Iterator[str]:
    """Imports under another name: two things have one name."""
    for module in sources:
        for node in module.nodes:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                for alias in node.names:
                    if alias.asname and (alias.name, alias.asname) not in USUAL:
                        yield module.at(
                            node, f"{alias.name} is imported as {alias.asname}: give it a name of its own"
                        )


def twins(sources: list[Module]) -> Iterator[str]:
    """Class names that stand for two things."""
    classes: dict[str, list[str]] = defaultdict(list)
    for module in sources:
        for node in module.nodes:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                classes[node.name].append(module.at(node, node.name))
    for name, places in sorted(classes.items()):
        if len(places) > 1:
            yield f"{name} stands for {len(places)} things: {', '.join(p.rsplit(': ', 1)[0] for p in places)}"


def same_functions(sources: list[Module]) -> Iterator[str]:
    """Names of functions that one folder imports from two modules."""
    functions = {f"{module.name}.{name}" for module in sources for name in module.functions()}
    homes_of: dict[tuple[str, str], set[str]] = defaultdict(set)
    for module in sources:
        if isinstance(module, Compiled):
            continue
        for node, target in imports(module):
            if isinstance(node, ast.ImportFrom) and target in functions:
                home, _, name = target.rpartition(".")
                homes_of[module.name.rpartition(".")[0], name].add(home)
    for (folder, name), found in sorted(homes_of.items()):
        if len(found) > 1:
            yield f"{folder}: {name} stands for {len(found)} things, of {' and '.join(sorted(found))}"


def dataclass_call(node: ast.ClassDef) -> ast.expr | None:
    """The decorator that makes it a dataclass."""
    for decorator in node.decorator_list:
        called = decorator.func if isinstance(decorator, ast.Call) else decorator
        if isinstance(called, ast.Name) and called.id == "dataclass":
            return decorator
    return None


def keywords(sources: list[Module]) -> Iterator[str]:
    """Dataclasses of many fields that may be made by position."""
    for module in sources:
        for node in module.nodes:
            decorator = dataclass_call(node) if isinstance(node, ast.ClassDef) else None
            if decorator is None:
                continue
            fields = [ast.unparse(s.annotation) for s in node.body if isinstance(s, ast.AnnAssign)]
            named = isinstance(decorator, ast.Call) and any(k.arg == "kw_only" for k in decorator.keywords)
            before = fields.index("KW_ONLY") if "KW_ONLY" in fields else len(fields)
            if len(fields) >= KEYWORD_FIELDS and not named and before > 3:
                yield module.at(node, f"{node.name} has {len(fields)} fields: make it by keyword (kw_only)")


def words(sources: list[Module]) -> Iterator[str]:
    """Docstrings that make a reader stop, and files of two topics, of the product, its tests and its tools."""
    for module in sources:
        for line, said in module.docstrings():
            if NO_BEGINNING.match(said):
                yield module.at_line(line, "a docstring begins with a verb or a noun")
        lines = len(module.text.splitlines())
        if lines > MAX_LINES:
            yield module.at_line(1, f"{lines} lines: more than one topic?")


def comments(sources: list[Module]) -> Iterator[str]:
    """Comments that do not stand above their line, in the product, its tests and its tools."""
    for module in sources:
        for line, code, comment in module.comments():
            if code and not FOR_TOOLS.match(comment):
                yield module.at_line(line, "a comment stands above its line")


def breaches() -> list[str]:
    """All that is against the rules."""
    sources, in_cython = modules(), compiled()
    everything = [*sources, *in_cython, *beside()]
    return [line for rule in (outside, aliases, twins, keywords) for line in rule(sources)] + [
        *words(everything),
        *comments(everything),
        *same_functions([*sources, *in_cython]),
        *cimports(in_cython),
        *uncalled([*sources, *in_cython]),
    ]


if __name__ == "__main__":
    # half of the time would go into looking through the trees, which are kept
    gc.disable()
    found = breaches()
    print("\n".join(found) or "the rules of imports and names hold")
    sys.exit(bool(found))

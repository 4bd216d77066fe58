"""The shape of the sources: no import circle, no file or function that does not fit, no private name imported.

import-linter checks the order of packages and subpackages; this checks the rest, computed from the syntax trees:
circles between single modules, with the imports inside functions and those for types alone, since both say that
neither module can be understood without the other.

What does not hold yet is listed below with its reason. An entry that is no longer needed fails too: the lists only
shrink.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from itertools import takewhile
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "gbspec"

MOST_LINES = 450
MOST_LINES_OF_A_FUNCTION = 60

CIRCLES: set[frozenset[str]] = set()
"""Circles of imports that are known, each as the set of its modules."""

LONG_FILES: set[str] = set()
LONG_FUNCTIONS: set[str] = {
    # the class of torch operations stands inside a function, since a generated module imports torch only when asked to
    "gbspec.backends.module.template.arithmetic._torch_arithmetic",
}
PRIVATE: set[str] = set()


@cache
def trees() -> dict[str, tuple[Path, ast.Module]]:
    """Every module of the package: its path and its syntax tree."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = path, ast.parse(path.read_text(encoding="utf-8"))
    return found


@cache
def door(package: str) -> dict[str, str]:
    """What a package offers at its door: the module of each name, or the module so named; empty where it has none."""
    path = trees()[package][0].with_suffix(".pyi")
    if path.name != "__init__.pyi" or not path.is_file():
        return {}
    found = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        assert isinstance(node, ast.ImportFrom) and node.level == 1, f"{path} holds more than imports"
        for alias in node.names:
            found[alias.name] = f"{package}.{node.module or alias.name}"
    return found


@cache
def imports(module: str) -> list[tuple[str, str | None, str]]:
    """Of each import of something of gbspec, wherever it stands: the module, the name taken from it, the name given.

    A name taken at a package's door is taken from the module that defines it.
    """
    known, found = trees(), []
    for node in ast.walk(known[module][1]):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                if whole in known:
                    found.append((whole, None, alias.asname or alias.name))
                elif node.module in known and alias.name in door(node.module):
                    found.append((door(node.module)[alias.name], alias.name, alias.asname or alias.name))
                elif node.module in known:
                    found.append((str(node.module), alias.name, alias.asname or alias.name))
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name in known:
                    found.append((alias.name, None, alias.asname or alias.name))
    return found


def circles() -> set[frozenset[str]]:
    """The strongly connected sets of two modules and more (Tarjan 1972), a module that imports itself included."""
    graph = {module: sorted({target for target, _, _ in imports(module)}) for module in trees()}
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    found: set[frozenset[str]] = set()

    def visit(module: str) -> None:
        number[module] = lowest[module] = len(number)
        stack.append(module)
        for target in graph[module]:
            if target not in number:
                visit(target)
                lowest[module] = min(lowest[module], lowest[target])
            elif target in stack:
                lowest[module] = min(lowest[module], number[target])
        if lowest[module] == number[module]:
            cut = stack.index(module)
            together = frozenset(stack[cut:])
            del stack[cut:]
            if len(together) > 1 or module in graph[module]:
                found.add(together)

    for module in graph:
        if module not in number:
            visit(module)
    return found


def compare(kind: str, found: set[str], allowed: set[str]) -> None:
    """Fails for what is new and for what is listed without need."""
    new, stale = found - allowed, allowed - found
    assert not new, f"{kind}: " + "; ".join(sorted(new))
    assert not stale, f"no longer needed in the list of {kind}: " + "; ".join(sorted(stale))


def test_no_modules_import_each_other() -> None:
    found, allowed = ({" <-> ".join(sorted(circle)) for circle in each} for each in (circles(), CIRCLES))
    compare("import circles", found, allowed)


def test_files_are_short() -> None:
    paths = [path for path in PACKAGE.rglob("*") if path.suffix in (".py", ".c")]
    long = {
        path.relative_to(ROOT).as_posix()
        for path in paths
        if len(path.read_text(encoding="utf-8").splitlines()) > MOST_LINES
    }
    compare("long files", long, LONG_FILES)


def test_functions_fit_on_a_screen() -> None:
    long = {
        f"{module}.{node.name}"
        for module, (_, tree) in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or node.lineno) - node.lineno + 1 > MOST_LINES_OF_A_FUNCTION
    }
    compare("long functions", long, LONG_FUNCTIONS)


def test_private_names_stay_in_their_package() -> None:
    """A name that begins with an underscore is known in the folder of its module and in the one above, nowhere else."""
    known = trees()
    found = set()
    for module, (path, tree) in known.items():
        foreign = {}
        for target, taken, given in imports(module):
            if path.parent in (known[target][0].parent, known[target][0].parent.parent):
                continue
            foreign[given] = target if taken is None else f"{target}.{taken}"
            for part in (target.rpartition(".")[2], taken or ""):
                if _private(part):
                    found.add(f"{module} imports {foreign[given]}")
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Attribute)
                and _private(node.attr)
                and isinstance(node.value, ast.Name)
                and node.value.id in foreign
            ):
                found.add(f"{module} uses {foreign[node.value.id]}.{node.attr}")
    compare("private names used from outside", found, PRIVATE)


def _private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def entered(path: Path, module: str) -> Iterator[str]:
    """The modules that a module enters from outside of the packages that it stands in, past what these offer."""
    known = trees()
    own = (module if path.name == "__init__.py" else module.rpartition(".")[0]).split(".")

    def deep(name: str) -> bool:
        parts = name.split(".")
        return len(parts) > len([*takewhile(lambda pair: pair[0] == pair[1], zip(own, parts, strict=False))]) + 1

    for node in ast.walk(known[module][1]):
        if isinstance(node, ast.ImportFrom) and node.module in known:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                if deep(node.module):
                    yield node.module
                elif whole in known and deep(whole) and door(node.module).get(alias.name) != whole:
                    yield whole
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known and deep(alias.name))


def test_packages_are_entered_by_their_doors() -> None:
    """An import reaches no deeper than into a package beside one of those that the importing module stands in.

    A module inside of such a package is taken whole, and only if the package offers it.
    """
    found = {
        f"{module} imports from {target}"
        for module, (path, _) in trees().items()
        for target in entered(path, module)
        # the template is text of a generated module, and reads as one
        if ".template" not in f"{module} {target}"
    }
    compare("imports from inside of other packages", found, set())


def test_doors_offer_what_there_is() -> None:
    for package in trees():
        for name, module in door(package).items():
            assert module in trees(), f"{package} offers {name} from {module}, which does not exist"
            whole, offered = import_module(module), getattr(import_module(package), name)
            if module == f"{package}.{name}":
                assert offered is whole
            else:
                assert f"{package}.{name}" not in trees(), f"{package} offers {name} and has a module of that name"
                assert offered is getattr(whole, name)


def test_no_variable_of_a_comprehension_hides_a_name_of_its_module() -> None:
    """Python 3.12 takes such a name, used again in the same function, for an unbound local variable."""
    found = set()
    for module, (_, tree) in trees().items():
        names = {alias.asname or alias.name for node in tree.body for alias in getattr(node, "names", ())}
        names |= {node.name for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef):
                bound = {
                    part.id
                    for node in ast.walk(function)
                    if isinstance(node, ast.comprehension)
                    for part in ast.walk(node.target)
                    if isinstance(part, ast.Name)
                }
                found |= {f"{module}.{function.name}: {name}" for name in bound & names}
    compare("comprehensions whose variable hides a name of the module", found, set())

"""Files, modules, functions and classes that pages name exist.

A path is taken from the root of the repository or from ``chronoscene/``; ``path.py:name`` and
``chronoscene.module.name`` name what a module defines, ``Class.method`` included.
"""

import ast
import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [
    path
    for path in subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-co", "--exclude-standard", "*.md"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    if not path.startswith("chronoscene/cli/methods/skeleton")
]
GROUPS = ("chronoscene.programs", "chronoscene.extractors", "chronoscene.matchers")
"""Groups of entry points, which are no modules."""
PACKAGES = ("chronoscene", "chronogs", "baselines", "leaderboard", "benchmarks")
BASES = (ROOT, ROOT / "chronoscene")


def code_spans(page: str) -> set[str]:
    """Text between backticks outside of blocks of code."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return set(re.findall(r"`([^`\n]+)`", text))


def is_ours(path: str) -> bool:
    """Return True if the first folder of a path is one of the repository's or the package's."""
    first = path.split("/")[0]
    if path.endswith((".py", ".md", ".toml", ".j2", ".css", ".js", ".bib")):
        return "/" in path and any((base / first).is_dir() for base in BASES)
    return first in (*PACKAGES, "tests", "docs") and "/" in path


def files_of(path: str) -> list[Path]:
    return [file for base in BASES for file in base.glob(path.rstrip("/"))]


@cache
def names_of(file: Path) -> frozenset[str]:
    """Everything that a module defines, imports of packages included."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    found = set()
    for node in tree.body:
        found |= _names(node)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{name}" for item in node.body for name in _names(item)}
            found |= {f"{node.name}.{name}" for name in _own_attributes(node)}
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return frozenset(found | {a.asname or a.name for node in imports for a in node.names})


def _names(node: ast.stmt) -> set[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return {target.id for target in targets if isinstance(target, ast.Name)}


def _own_attributes(node: ast.ClassDef) -> set[str]:
    return {
        item.attr
        for item in ast.walk(node)
        if isinstance(item, ast.Attribute)
        and isinstance(item.value, ast.Name)
        and item.value.id == "self"
    }


def module_has(dotted: str) -> bool:
    """Return True if ``package.module`` or ``package.module.Name`` is there."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:length])
        for file in (place.with_suffix(".py"), place / "__init__.py"):
            if file.is_file():
                rest = ".".join(parts[length:])
                return not rest or rest in names_of(file)
    return False


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_names_exists(page: str) -> None:
    wrong = []
    for span in sorted(code_spans(page)):
        if match := re.fullmatch(r"([\w./*-]+?)(?::([\w.]+))?", span):
            path, name = match.groups()
            if is_ours(path) and "NAME" not in path:
                files = files_of(path)
                if not files or (name and not any(name in names_of(f) for f in files)):
                    wrong.append(span)
                continue
        modules = rf"(?:{'|'.join(PACKAGES)})(?:\.\w+)+"
        match = re.match(rf"(?:python -m )?({modules})(?![\w/-])", span)
        if match and match[1] not in GROUPS and not module_has(match[1]):
            wrong.append(span)
    assert not wrong


def test_files_of_the_architecture_page_exist() -> None:
    """Files that it names without a folder are in ``chronoscene/``, or in a folder named before."""
    page = "docs/reference/architecture.md"
    for span in code_spans(page):
        if match := re.fullmatch(r"(\w+\.py)(?::([\w.]+))?", span):
            files = [ROOT / "chronoscene" / match[1], *(ROOT / "baselines").rglob(match[1])]
            assert any(file.is_file() for file in files), span

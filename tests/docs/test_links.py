"""Links in Markdown files lead somewhere, to files and to headings."""

import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = subprocess.run(
    ["git", "-C", str(ROOT), "ls-files", "-co", "--exclude-standard", "*.md"],
    capture_output=True,
    text=True,
    check=True,
).stdout.splitlines()


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


@cache
def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a page, named as GitHub names them; the first of equal ones."""
    found = set()
    for heading in re.findall(r"^#+ (.*)$", without_code(path.read_text("utf-8")), re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", plain.strip().lower()).replace(" ", "-")
        found.add(name)
    return found


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    path = ROOT / page
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", without_code(path.read_text("utf-8"))):
        if re.match(r"\w+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert not broken


def test_pages_that_are_named_exist() -> None:
    """Pages that code and messages name, without a link, are there."""
    done = subprocess.run(
        ["git", "-C", str(ROOT), "grep", "-nE", r"docs/[A-Za-z0-9_/-]+\.md"],
        capture_output=True,
        text=True,
    )
    lines = [line for line in done.stdout.splitlines() if "test_links.py" not in line]
    names = {name for line in lines for name in re.findall(r"docs/[\w/-]+\.md", line)}
    assert not {name for name in names if not (ROOT / name).exists()}

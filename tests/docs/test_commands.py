"""docs/reference/commands.md has the help of all commands as they are."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from chronoscene.cli import COMMANDS

SCRIPT = Path(__file__).parents[2] / "docs/make_commands.py"


def test_the_page_is_what_the_script_writes() -> None:
    spec = importlib.util.spec_from_file_location("make_commands", SCRIPT)
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    page = script.commands_page()
    missing = [name for name in COMMANDS if f"### `chronoscene {name}`\n" not in page]
    assert not missing, "their package needs a title in docs/make_commands.py"
    written = script.PAGE.read_text(encoding="utf-8")
    assert written == page, "run python docs/make_commands.py"

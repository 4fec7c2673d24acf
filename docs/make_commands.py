"""Write the page of commands from their help: ``python docs/make_commands.py``."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli import SECTIONS, cli

PAGE = Path(__file__).parent / "reference" / "commands.md"

HEAD = """\
# Commands

The text of `--help` of all commands, by section. `python docs/make_commands.py` writes this page
anew; a test compares it with the program.

Exit status: 0 success; 1 the command found what it was asked to look for (a validator's error, a
broken rule of a method), or part of its work failed, as it reports; 2 wrong usage, or input that
cannot be read; 130 after Ctrl-C. `python -m chronoscene` is the same as `chronoscene`.
"""


def commands_page() -> str:
    """Return the page in Markdown."""
    parts = [HEAD, _contents()]
    for title, commands in SECTIONS.items():
        parts.append(f"## {title}\n")
        parts += [_command(name) for name in commands]
    return "\n".join(parts)


def _contents() -> str:
    rows = []
    for title, commands in SECTIONS.items():
        rows.append(f"- {title}:")
        rows += [f"  [`{name}`](#chronoscene-{name})" for name in commands]
    return "\n".join([*rows, ""])


def _command(name: str) -> str:
    """One command: usage, description, options."""
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    context = click.Context(command, info_name=f"chronoscene {name}", show_default=True)
    usage = " ".join([context.info_name or "", *command.collect_usage_pieces(context)])
    records = [
        record
        for option in command.params
        if isinstance(option, click.Option)
        and (record := option.get_help_record(context)) is not None
    ]
    rows = [f"| `{_cell(option)}` | {_cell(text)} |" for option, text in records]
    text = "\n\n".join(
        " ".join(part.replace("\b", "").split()) for part in (command.help or "").split("\n\n")
    )
    table = "\n".join(["| option | meaning |", "| --- | --- |", *rows])
    return f"### `chronoscene {name}`\n\n```text\n{usage}\n```\n\n{_escaped(text)}\n\n{table}\n"


def _cell(text: str) -> str:
    return _escaped(" ".join(text.split())).replace("|", "\\|")


def _escaped(text: str) -> str:
    """Text whose angle brackets and asterisks Markdown leaves alone."""
    return text.replace("<", "&lt;").replace("*", "\\*")


if __name__ == "__main__":
    PAGE.write_text(commands_page(), encoding="utf-8")

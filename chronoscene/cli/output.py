"""What commands with ``--out`` print or write."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from chronoscene.errors import ConfigError
from chronoscene.files import write_text_atomic


def emit(text: str, out: Path | None) -> None:
    """Print a text, or write it to the file that ``--out`` names, without colours.

    What the terminal's encoding lacks is printed as an escape sequence.

    Raises:
        ConfigError: If the file cannot be written.
    """
    if out is None:
        encoding = sys.stdout.encoding or "utf-8"
        click.echo(text.encode(encoding, "backslashreplace").decode(encoding), nl=False)
        return
    try:
        write_text_atomic(out, click.unstyle(text))
    except OSError as error:
        raise ConfigError(
            f"--out {out}",
            expected="a file that can be written",
            found=error.strerror or "an error",
            todo="choose another place",
        ) from error

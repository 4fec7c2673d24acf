"""Output of commands; errors name the option that a path came from."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from errno import EISDIR
from os import strerror
from pathlib import Path
from shutil import get_terminal_size
from tempfile import TemporaryFile
from typing import Any

import click

from chronoscene.errors import ConfigError
from chronoscene.io.staging import check_outside, is_stream, write_text_atomic
from chronoscene.io.tables import FORMATS
from chronoscene.io.wording import printable, printable_lines

A_FILE = "a file that can be written"
FORMAT = click.option(
    "--format", "style", type=click.Choice(FORMATS), default="table", help="Output format."
)
OUT_FILE = click.option(
    "--out", type=click.Path(path_type=Path), help="Write to this file instead of the terminal."
)


def emit(text: str, out: Path | None = None, *, option: str = "--out") -> None:
    """Print a text, or write it to a file without colours.

    Characters that the terminal lacks, or that could disturb it, are printed as escape sequences.

    Args:
        text: With the end of its last line.
        out: The file; None to print.
        option: Option that named the file.

    Raises:
        ConfigError: If the file cannot be written.
    """
    if out is None:
        encoding = sys.stdout.encoding or "utf-8"
        text = printable_lines(text)
        click.echo(text.encode(encoding, "backslashreplace").decode(encoding), nl=False)
        return
    whole = click.unstyle(text).encode("utf-8", "backslashreplace").decode()  # names may be bytes
    with writing_to(option, out, expected=A_FILE):
        write_text_atomic(out, whole)
    report_written(out)


def say(line: str, **style: Any) -> None:
    """Print a line to standard error, in the style of `click.style`; names in it are only text."""
    click.secho(printable(line), err=True, reset=bool(style), **style)


def terminal_width(out: Path | None = None) -> int | None:
    """Return the width of the terminal in characters; None if the text does not go to one."""
    return get_terminal_size().columns if out is None and sys.stdout.isatty() else None


def report_written(*places: Path) -> None:
    """Print the names of written files to standard error: standard output is for results."""
    for place in places:
        say(f"wrote {place}")


@contextmanager
def showing_notes() -> Iterator[None]:
    """Print the notes of an error that ends the block, before the error itself is printed."""
    try:
        yield
    except BaseException as error:
        for note in getattr(error, "__notes__", ()):
            say(f"note: {note}")
        raise


@contextmanager
def writing_to(
    option: str, place: Path, *, expected: str = "a place that can be written to"
) -> Iterator[None]:
    """Turn an OSError in the block into a ConfigError that names the option."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"{option} {place}",
            expected=expected,
            found=error.strerror or "an error",
            todo="choose another place",
        ) from error


def check_place(option: str, folder: Path, *, outside: Iterable[Path] = ()) -> None:
    """Check that a folder can be created and written to; create nothing.

    Args:
        option: Option that named the folder.
        folder: It need not exist.
        outside: Scenes, and folders of photos, that it must not be in.

    Raises:
        ConfigError: If it cannot, or is in one of them.
    """
    check_outside(folder, outside, option=option)
    with writing_to(option, folder):
        nearest = next(p for p in (folder, *folder.absolute().parents) if p.exists())
        with TemporaryFile(dir=nearest):
            pass


def check_file(option: str, file: Path | None, *, outside: Iterable[Path] = ()) -> None:
    """Check that a file can be written; leave nothing there.

    Args:
        option: Option that named the file.
        file: None if there is none to write.
        outside: As for `check_place`.

    Raises:
        ConfigError: If it cannot, or is in one of them.
    """
    if file is None:
        return
    check_outside(file, outside, option=option)
    if is_stream(file):
        return
    with writing_to(option, file, expected=A_FILE):
        if file.is_dir():
            raise IsADirectoryError(EISDIR, strerror(EISDIR))
        with TemporaryFile(dir=file.absolute().parent):
            pass

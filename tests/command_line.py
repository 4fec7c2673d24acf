"""The command line as from a shell, in this process."""

import click
import pytest
from click.testing import CliRunner, Result

from chronoscene.cli import main

_MAIN = click.Command("chronoscene", callback=main)


def run_command(*arguments: object, color: bool = False) -> Result:
    """Run ``chronoscene``; its errors are printed, and end it, as they do in a shell."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["chronoscene", *map(str, arguments)])
        return CliRunner().invoke(_MAIN, color=color)

"""The command line as from a shell, in this process."""

import click
import pytest
from click.testing import CliRunner, Result

from chronoscene.cli import cli, main

_MAIN = click.Command("chronoscene", callback=main)


def run_command(*arguments: object, color: bool = False) -> Result:
    """Run ``chronoscene``; its errors are printed, and end it, as they do in a shell."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["chronoscene", *map(str, arguments)])
        return CliRunner().invoke(_MAIN, color=color)


def refused(*arguments: object) -> str:
    """Return what `run_command` prints of arguments that it refuses."""
    result = run_command(*arguments)
    assert result.exit_code == 2, result.output
    return result.stderr


def invoke(*arguments: object) -> Result:
    """Run ``chronoscene``; its errors are raised."""
    return CliRunner().invoke(cli, [*map(str, arguments)], catch_exceptions=False)


def succeed(*arguments: object) -> Result:
    """`invoke` a command that must end without complaint."""
    result = invoke(*arguments)
    assert result.exit_code == 0, result.output
    return result

"""Options that several commands share."""

import click
import pytest
from click.testing import CliRunner

from chronoscene.cli import COMMANDS, cli
from chronoscene.cli.options import FiniteFloat


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_a_number_that_is_not_finite_is_a_usage_error(number):
    @click.command()
    @click.option("--size", type=FiniteFloat(), default=1)
    def command(size: float) -> None:
        raise AssertionError

    result = CliRunner().invoke(command, ["--size", number])
    assert result.exit_code == 2
    assert f"'--size': expected a finite number, found {number}" in result.output


def test_ranges_of_numbers_are_finite():
    context = click.Context(cli)
    commands = [cli.get_command(context, name) for name in COMMANDS]
    types = [option.type for command in commands for option in command.params]
    ranges = [each for each in types if isinstance(each, click.FloatRange)]
    assert len(ranges) > 10 and all(isinstance(each, FiniteFloat) for each in ranges)

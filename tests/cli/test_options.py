"""Options that several commands share."""

import re

import click
import pytest
from click.testing import CliRunner

from chronoscene.cli import COMMANDS, cli
from chronoscene.cli.options import IMAGE_SIZE, FiniteFloat, OneOfSeveral, refuse_options
from chronoscene.errors import ConfigError


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fps", "5"], "--fps: expected no such option without a film, found one; leave it out"),
        (["a"], "place: expected no such argument without a film, found one; leave it out"),
        (["--fps", "5", "--codec", "x"], "--codec, --fps: .* options .*, found 2; leave them out"),
        (["a", "--fps", "5"], "place, --fps: expected no such options without a film, found 2;"),
    ],
)
def test_options_without_an_effect_are_refused_by_name(arguments, message):
    @click.command()
    @click.argument("place", required=False)
    @click.option("--codec", default="y")
    @click.option("--fps")
    def command(**_options: str) -> None:
        refuse_options(("fps", "codec", "place"), "without a film")

    assert CliRunner().invoke(command, []).exit_code == 0
    refused = CliRunner().invoke(command, arguments).exception
    assert isinstance(refused, ConfigError) and re.match(message, str(refused))


@pytest.mark.parametrize("option", ["--out", "--out=maps"])
def test_an_option_in_place_of_one_of_several_values_is_named(option):
    rest = [option] if "=" in option else [option, "maps"]
    result = CliRunner().invoke(cli, ["changes", "run", "--between", "before", *rest])
    assert result.exit_code == 2
    message = f"'--between': expected PERIOD PERIOD, found the option {option} in place of one"
    assert message in result.output


def test_options_of_several_values_know_the_options():
    context = click.Context(cli)
    options = [option for name in COMMANDS for option in cli.get_command(context, name).params]
    several = [o for o in options if isinstance(o, click.Option) and o.nargs > 1]
    assert several and all(isinstance(option.type, OneOfSeveral) for option in several)


def test_sizes_of_images():
    assert IMAGE_SIZE.convert(" 320X240 ", None, None) == (320, 240)
    for text in ("320", "-4x10", "4x10x3", "٣x٤", "4 x 10"):
        with pytest.raises(click.BadParameter, match="expected WIDTHxHEIGHT, such as 320x240"):
            IMAGE_SIZE.convert(text, None, None)

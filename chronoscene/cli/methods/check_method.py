"""``chronoscene check-method`` and ``new-method``: for those who write a method."""

from __future__ import annotations

import re
import shlex
from importlib.util import find_spec
from keyword import iskeyword
from pathlib import Path

import click

from chronoscene.cli.options import FOLDER, look_here_for
from chronoscene.errors import ConfigError
from chronoscene.io.staging import staged_folder

SOME_FAILED = 1  # Exit status when the method breaks a rule

EXAMPLE = "tinted-gaussians"
SKELETON = Path(__file__).parent / "skeleton"
"""The package of this name, which new methods are copies of."""
KINDS = ("*.py", "*.toml", "*.md")  # Its own files; others are left there by Python and pip


@click.command("check-method")
@click.argument("name")
def check(name: str) -> None:
    """Check that a method keeps the rules for methods.

    NAME is an installed method, or module:SPEC. It is trained on generated images on the CPU, which
    takes about a minute. Each rule is printed on a line. Exit status: 1 if a rule was broken.
    """
    from chronoscene.harness.contract import check_method

    look_here_for([name])
    results = []
    for result in check_method(name):
        results.append(result)
        if result.problem is not None:
            click.secho(f"FAILED  {result.rule}\n        {result.problem}", fg="red")
        elif result.left_out is not None:
            click.echo(f"-       {result.rule}: {result.left_out}")
        else:
            click.echo(f"ok      {result.rule}")
    broken = sum(result.problem is not None for result in results)
    click.echo(f"{name}: {broken} of {len(results)} rules broken")
    if broken:
        click.get_current_context().exit(SOME_FAILED)


@click.command("new-method")
@click.argument("name")
@click.option("--out", type=FOLDER, help="New folder for the package.  [default: NAME]")
def new(name: str, out: Path | None) -> None:
    """Create the package of a new method.

    The package is a working method to begin with: Gaussians with a tint per period.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        raise ConfigError(
            "NAME",
            expected="a small letter, then small letters and digits, in words joined by hyphens",
            found=repr(name),
            todo="choose a name like my-method",
        )
    module = name.replace("-", "_")
    if iskeyword(module) or find_spec(module) is not None:
        raise ConfigError(
            "NAME",
            expected="a name that is neither a keyword nor a module of Python",
            found=f"{module!r}, which the package would hide",
            todo="choose another name",
        )
    out = out or Path(name)
    with staged_folder(out) as staging:
        for source in sorted(path for kind in KINDS for path in SKELETON.rglob(kind)):
            target = staging / renamed(source.relative_to(SKELETON).as_posix(), name)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(renamed(source.read_text(encoding="utf-8"), name), encoding="utf-8")
    click.echo(
        f"wrote {out}; next:\n"
        f"  pip install --editable {shlex.quote(str(out))}\n"
        f"  chronoscene check-method {name}\n"
        f"  chronoscene bench SCENE --method {name} --preset fast"
    )


def renamed(text: str, name: str) -> str:
    """A text of the example, with the new name in place of its own."""
    for joined in ("-", "_", " ", ""):
        old, new = (joined.join(word.split("-")) for word in (EXAMPLE, name))
        text = text.replace(old, new).replace(_titled(EXAMPLE, joined), _titled(name, joined))
    return text


def _titled(name: str, joined: str) -> str:
    return joined.join(word.capitalize() for word in name.split("-"))

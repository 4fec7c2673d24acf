"""``chronoscene synth``: make a synthetic multi-period scene with exact ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from chronoscene.cli.options import IMAGE_SIZE, PATH
from chronoscene.cli.output import say
from chronoscene.cli.progress import progress_bar
from chronoscene.io.wording import counted
from chronoscene.synth import PRESETS, generate, preset
from chronoscene.synth.settings import KINDS


@click.command("synth")
@click.argument("out", type=PATH)
@click.option("--preset", "name", default="demo",
              help=f"Sizes: {', '.join(PRESETS)}.")  # fmt: skip
@click.option("--periods", type=int, help="Number of dates of capture.")
@click.option("--kind", help=f"Cameras: {', '.join(KINDS[:-1])}, or {KINDS[-1]} (close together).")
@click.option(
    "--size", type=IMAGE_SIZE, metavar="WIDTHxHEIGHT", help="Size of the images in pixels."
)
@click.option(
    "--seed", type=int, help="Seed of the city; another one gives another city.  [default: 0]"
)
@click.option("--views", type=int, help="Mean number of images per period.")
@click.option("--points", type=int, help="Number of sparse points to aim for.")
@click.option("--noise", type=float, help="Noise of observed point positions in pixels.")
@click.option("--rebuilt", type=float, help="Share of the blocks that are torn down and rebuilt.")
@click.option("--same-light", is_flag=True, default=None,
              help="Sun, sky and season stay; only objects change.")  # fmt: skip
@click.option("--off-centre/--centred", "off_centre", default=None,
              help="Principal point away from the image centre, or in it.")  # fmt: skip
def command(out: Path, name: str, size: tuple[int, int] | None, **changes: Any) -> None:
    """Generate a city photographed at several dates.

    OUT is a new folder in the ChronoScene format; OUT/gt has depth, change masks and the test views
    at every other date. Equal options give equal bytes.
    """
    given = {key: value for key, value in changes.items() if value is not None}
    if size is not None:
        given["width"], given["height"] = size
    settings = preset(name, **given)
    with progress_bar() as bar:
        generate(out, settings, bar)
    say(f"{out}: {counted(settings.periods, 'period')}, seed {settings.seed}")

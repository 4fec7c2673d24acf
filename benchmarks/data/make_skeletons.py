"""Write scenes with as many images and points per period as those of the paper.

    python -m benchmarks.data.make_skeletons OUT [--scene Aerial3 ...] [--size 64x48] [--seed 0]

OUT becomes a folder of scenes with tiny images of coloured noise, about 1.1 GB for all twelve.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.data.skeletons.dataset import write_dataset
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.scenes.synth import parse_size
from chronoscene.errors import ChronoSceneError


def main() -> None:
    """Parse the command line and write the scenes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="new or empty folder")
    parser.add_argument("--scene", action="append", help="only this scene; may be repeated")
    parser.add_argument("--size", default="64x48", help="of cameras and images, in pixels")
    parser.add_argument("--seed", type=int, default=0, help="another seed is another place")
    options = parser.parse_args()
    try:
        size = parse_size(options.size)
        with progress_bar() as bar:
            write_dataset(
                options.out,
                scenes=options.scene,
                seed=options.seed,
                size=size,
                progress=lambda done, total, what: bar(what, done, total),
            )
    except ChronoSceneError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()

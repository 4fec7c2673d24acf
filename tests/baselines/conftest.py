"""Makes ``toy_scene`` of tests/gaussians importable."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "gaussians" / "support"))

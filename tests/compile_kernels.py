"""Compiles the kernels of methods before the tests: their processes would each do it.

python -m tests.compile_kernels [--scene] METHOD...
"""

import argparse
import tempfile
from pathlib import Path

from chronoscene.harness.train.warm_up import warm_up
from chronoscene.methods import import_object, load_spec
from chronoscene.synth import generate, preset

parser = argparse.ArgumentParser()
parser.add_argument("methods", nargs="*")
parser.add_argument("--scene", action="store_true", help="those of generated scenes, too")
arguments = parser.parse_args()
if arguments.scene:
    with tempfile.TemporaryDirectory() as folder:
        generate(Path(folder) / "scene", preset("tiny", views=4))
for name in arguments.methods:
    spec = load_spec(name)
    config = import_object(spec.config)()
    if notice := warm_up(spec, config, num_periods=2, device="cpu"):
        raise SystemExit(f"{name}: {notice}")

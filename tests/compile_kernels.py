"""Compiles the kernels of methods before the tests: their processes would each do it.

python -m tests.compile_kernels [--scene] METHOD...
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from chronoscene.harness.contract.tiny_training import small_config
from chronoscene.harness.train.warm_up import warm_up
from chronoscene.methods import load_spec
from chronoscene.synth import generate, preset

OPTIONS = {"exposure": "image", "depth_weight": 0.1, "period_decay": 0.1}
"""Options that have kernels of their own."""

parser = argparse.ArgumentParser()
parser.add_argument("methods", nargs="*")
parser.add_argument("--scene", action="store_true", help="those of generated scenes, too")
arguments = parser.parse_args()
if arguments.scene:
    with tempfile.TemporaryDirectory() as folder:
        generate(Path(folder) / "scene", preset("tiny", views=4))
for name in arguments.methods:
    spec = load_spec(name)
    plain = small_config(spec)
    known = {k: v for k, v in OPTIONS.items() if hasattr(plain, k)}
    for config in (plain, replace(plain, **known)):
        if notice := warm_up(spec, config, num_periods=2, device="cpu"):
            raise SystemExit(f"{name}: {notice}")

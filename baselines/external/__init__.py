"""Recipes for external programs, installed separately: commands and places of files.

Written from the documentation and the sources of the programs; `Runner.tested` says what was tried.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import Any

from chronoscene.methods import MethodSpec, ProgramConfig, Runner


def _words(command: str) -> tuple[str, ...]:
    return tuple(shlex.split(command))


_TESTED = "untested but for its loader, which reads the exported data as it is"


@dataclass(frozen=True, slots=True)
class ChronoGSConfig(ProgramConfig):
    """Options of the official ChronoGS."""

    iterations: int = 40_000


@dataclass(frozen=True, slots=True)
class FourDGaussiansConfig(ProgramConfig):
    """Options of the official 4DGaussians."""

    iterations: int = 14_000
    """Iterations of the fine stage; the coarse one before it has 3,000."""
    arguments: str = "arguments/hypernerf/default.py"
    """File below `source` with all other options: the one that its page names for own scenes."""


@dataclass(frozen=True, slots=True)
class CLNeRFConfig(ProgramConfig):
    """Options of the official CLNeRF."""

    iterations: int = 20_000
    """Steps of each period, a multiple of the 1,000 of an epoch."""
    scale: float = 8.0
    """Half the edge of the cube that is modelled; the 99.9th percentile of the depths of points is
    8. Its scripts have 8 indoors, and 16 or 32 outdoors."""


SPLATFACTO = MethodSpec(
    name="nerfstudio-splatfacto",
    title="Splatfacto (nerfstudio)",
    paper="Tancik et al., Nerfstudio, 2023; Ye et al., gsplat, 2025",
    licence="Apache-2.0",
    period_input="none",
    outputs=("rgb",),
    devices=("cuda",),
    method="",
    config="chronoscene.methods:ProgramConfig",
    presets={"balanced": {}, "fast": {"iterations": 7_000}},
    runner=Runner(
        exports="nerfstudio",
        prepare="baselines.external.prepare:splatfacto",
        train=_words(
            "ns-train splatfacto --output-dir {output} --experiment-name run --timestamp run "
            # The default, a viewer, would wait for its user after the training.
            "--max-num-iterations {iterations} --machine.seed {seed} --vis tensorboard "
            "nerfstudio-data --data {data} --load-3D-points True"
        ),
        render=(
            _words(
                "ns-render dataset --load-config {output}/run/splatfacto/run/config.yml "
                "--output-path {output}/renders --split test "
                "--rendered-output-names rgb --image-format png"
            ),
            _words(
                "ns-export gaussian-splat --output-dir {output}/export "
                "--load-config {output}/run/splatfacto/run/config.yml"
            ),
        ),
        images="renders/test/rgb/{name}.png",
        model="export/splat.ply",
        primitives="export/splat.ply",
        unit="Gaussians",
        version=_words(
            'python -c "from importlib.metadata import version; '
            "print('nerfstudio', version('nerfstudio'))\""
        ),
        tested=_TESTED,
    ),
)

_OFFICIAL: dict[str, Any] = {
    "period_input": "label",
    "outputs": ("rgb",),
    "devices": ("cuda",),
    "method": "",
    "presets": {"balanced": {}},
}
"""Properties that the official programs have in common."""

CHRONOGS = MethodSpec(
    name="chronogs-official",
    title="ChronoGS (official)",
    paper="Wang et al., ChronoGS, CVPR 2026",
    licence="that of 3DGS: research and evaluation only",
    config="baselines.external:ChronoGSConfig",
    **_OFFICIAL,
    runner=Runner(
        exports="chronoscene",
        prepare="baselines.external.prepare:chronogs",
        train=_words(
            "python {source}/train.py --config {output}/config.yaml "
            "--source_path {data} --model_path {output}/model"
        ),
        render=(_words("python {source}/render.py -m {output}/model -s {data} --skip_train"),),
        images="model/test/ours_{iterations}/renders/{index:05d}.png",
        model="model/point_cloud/iteration_{iterations}/*",
        primitives="model/point_cloud/iteration_{iterations}/point_cloud.ply",
        unit="anchors",
        version=_words("git -C {source} rev-parse HEAD"),
        tested="trained on an H200 with torch 2.11",
    ),
)

FOUR_D_GAUSSIANS = MethodSpec(
    name="4dgs-official",
    title="4DGaussians (official)",
    paper="Wu et al., 4D Gaussian Splatting for Real-Time Dynamic Scene Rendering, CVPR 2024",
    licence="that of 3DGS: research and evaluation only",
    config="baselines.external:FourDGaussiansConfig",
    **_OFFICIAL,
    runner=Runner(
        exports="nerfstudio",
        prepare="baselines.external.prepare:four_d_gaussians",
        train=_words(
            "python {source}/train.py -s {data} --model_path {output}/model "
            # Only on the command line: what a file says of iterations is read after this list.
            "--configs {output}/config.py --save_iterations {iterations}"
        ),
        render=(
            _words(
                "python {source}/render.py --model_path {output}/model "
                "--configs {output}/config.py --skip_train --skip_video"
            ),
        ),
        images="model/test/ours_{iterations}/renders/{index:05d}.png",
        model="model/point_cloud/iteration_{iterations}/*",
        primitives="model/point_cloud/iteration_{iterations}/point_cloud.ply",
        unit="Gaussians",
        version=_words("git -C {source} rev-parse HEAD"),
        tested=_TESTED,
    ),
)

CLNERF = MethodSpec(
    name="clnerf-official",
    title="CLNeRF (official)",
    paper="Cai and Müller, CLNeRF: Continual Learning Meets NeRF, ICCV 2023",
    licence="Apache-2.0; its page says: for non-commercial use",
    config="baselines.external:CLNeRFConfig",
    **_OFFICIAL,
    runner=Runner(
        exports="wat",
        prepare="baselines.external.prepare:clnerf",
        train=_words("sh {output}/train.sh"),
        render=(),
        images="results/NGPGv2/CLNerf/colmap_ngpa_CLNerf/run/{index:03d}.png",
        model="model.ckpt",
        version=_words("git -C {source} rev-parse HEAD"),
        tested=_TESTED,
    ),
)

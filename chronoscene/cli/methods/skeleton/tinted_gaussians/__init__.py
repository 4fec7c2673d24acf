"""Description of the method, which is read without importing it. Nothing heavy is imported here."""

from chronoscene.methods import MethodSpec

SPEC = MethodSpec(
    name="tinted-gaussians",  # on the command line
    title="Tinted Gaussians",  # in tables
    paper="none yet",
    licence="Apache-2.0",
    period_input="continuous",  # none: hidden from it; label: an integer; continuous: any number
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="tinted_gaussians.method:TintedGaussians",
    config="tinted_gaussians.method:Config",
    presets={  # balanced and fast are asked for; what they leave out has its default
        "balanced": {"iterations": 3_000, "reset_interval": 8_000},
        "fast": {"iterations": 1_000, "reset_interval": 30_000},
    },
    resumable=True,
)

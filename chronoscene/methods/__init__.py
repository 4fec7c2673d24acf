"""Methods: the data that describes one, and the interface that the harness drives.

A method is a plug-in. Its `MethodSpec` is pure data, found through the entry-point group
``chronoscene.methods``; listing methods imports nothing heavy. Its class fulfils `Method`. The
harness owns the loop, the clock, the seeds and the files; a method sees a `TrainingSet` in the
normalised training frame and never a dataset folder.

A method may instead be another program, which trains itself in an environment of its own: then its
spec has a `Runner` and no class, and its entry point is in the group ``chronoscene.programs``.

A method that splats Gaussians need not implement all of `Method`: `GaussianMethod` in
`chronoscene.gaussians` and `AnchorMethod` in `chronoscene.anchors` do it, and say what to override.
"""

from __future__ import annotations

from chronoscene.methods.interface import (
    POSITIONS,
    Method,
    MethodSize,
    PeriodSharing,
    Prediction,
    SparseDepths,
    StepReport,
    TrainingSet,
    TrainingView,
    View,
    has_function,
    make_method,
)
from chronoscene.methods.options import (
    MethodConfig,
    as_typed,
    build_config,
    check_options,
    config_from_values,
    options_of,
)
from chronoscene.methods.preset_files import is_preset_file, preset_name
from chronoscene.methods.spec import (
    PROGRAM_GROUP,
    MethodSpec,
    ProgramConfig,
    Range,
    Runner,
    import_object,
    installed_methods,
    load_spec,
    method_names,
)

__all__ = [
    "POSITIONS",
    "PROGRAM_GROUP",
    "Method",
    "MethodConfig",
    "MethodSize",
    "MethodSpec",
    "PeriodSharing",
    "Prediction",
    "ProgramConfig",
    "Range",
    "Runner",
    "SparseDepths",
    "StepReport",
    "TrainingSet",
    "TrainingView",
    "View",
    "as_typed",
    "build_config",
    "check_options",
    "config_from_values",
    "has_function",
    "import_object",
    "installed_methods",
    "is_preset_file",
    "load_spec",
    "make_method",
    "method_names",
    "options_of",
    "preset_name",
]

"""Dataset toolkit and benchmark harness for multi-period scene reconstruction."""

import os as _os
import typing as _typing

# Loaded before anything can import pycolmap: pycolmap 4.2.1 exports its own zlib symbols, and a
# process that loads it before the system's zlib aborts at its first compression.
import zlib as _zlib  # noqa: F401

# Numba tries TBB first and warns when it is too old; OpenMP also starts its threads quickest.
_os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")

# A training step starts threads a few hundred times. Threads that spin while they wait fight with
# whatever else runs: 300 ChronoGS steps on 2 cores took 5.5 s with waiting threads asleep, 6.4 s
# with spinning ones, and 22 to 28 s with spinning ones beside one other busy process.
_os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"

__all__ = [
    "BenchmarkResult",
    "Camera",
    "ChronoSceneError",
    "Frame",
    "GaussianCloud",
    "PredictedView",
    "Scene",
    "SceneReport",
    "Statistics",
    "TrainedRun",
    "bench",
    "open_run",
    "read_scene",
    "stats",
    "validate",
]
"""The public interface, which `chronoscene.api` defines."""

if _typing.TYPE_CHECKING:
    from chronoscene.api import (
        BenchmarkResult,
        Camera,
        ChronoSceneError,
        Frame,
        GaussianCloud,
        PredictedView,
        Scene,
        SceneReport,
        Statistics,
        TrainedRun,
        bench,
        open_run,
        read_scene,
        stats,
        validate,
    )
else:

    def __getattr__(name):
        """Import the public interface at its first use: ``import chronoscene`` itself is quick."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from chronoscene import api

        return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

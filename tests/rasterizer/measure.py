"""Worst differences between the CPU backend and the reference; see tolerances.py.

python tests/rasterizer/measure.py [scenes]
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings


def _conftest() -> Any:
    path = Path(__file__).parent / "conftest.py"
    spec = importlib.util.spec_from_file_location("rasterizer_conftest", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules["rasterizer_conftest"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(count: int) -> None:
    tools, worst = _conftest(), dict[str, float]()

    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(tools.scenes())
    def measure(scene: Any) -> None:
        if not tools._well_posed(scene):
            return
        comparison = tools.compare(scene)
        for name in comparison.expected:
            if name != "radii":
                error = comparison.error(name, 1e-3)
                if error > worst.get(name, 0.0):
                    worst[name] = error
                    if error > 1e-3:
                        print(name, error, scene)

    measure()
    for name, error in sorted(worst.items()):
        print(f"{name:18} {error:.1e}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)

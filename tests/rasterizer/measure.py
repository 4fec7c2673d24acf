"""Worst differences between the CPU backend and the reference; see tolerances.py.

python tests/rasterizer/measure.py [scenes]
"""

from __future__ import annotations

import sys
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from rasterizer_cases.comparison import compare
from rasterizer_cases.scenes import scenes, well_posed


def main(count: int) -> None:
    worst = dict[str, float]()

    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(scenes())
    def measure(scene: Any) -> None:
        if not well_posed(scene):
            return
        comparison = compare(scene)
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

"""Fields of tests: in plain torch they are slow on a CPU."""

from typing import Any

SMALL_FIELD: dict[str, Any] = {
    "levels": 4, "log2_rows": 12, "finest": 64, "hidden": 16, "cells": 16,
}  # fmt: skip
SAME_NETWORKS = {"nerf-t", "nerf-w", "ha-nerf", "meil-nerf"}
"""Fields whose networks are among those of `nerf-w-t`, `ha-nerf-t` and `clnerf`."""

"""All rules, one module for each group. A new module is added to the imports below."""

from chronoscene.validation.rules import (
    cameras,
    duplicates,
    folder,
    images,
    model,
    official,
    periods,
    points,
    poses,
    reprojection,
    split,
    testlist,
)

__all__ = [
    "cameras",
    "duplicates",
    "folder",
    "images",
    "model",
    "official",
    "periods",
    "points",
    "poses",
    "reprojection",
    "split",
    "testlist",
]

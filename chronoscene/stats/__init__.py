"""Statistics of scenes: counts by period, geometry, overlap of the periods."""

from __future__ import annotations

from chronoscene.stats.counts import (
    COUNT_RULES,
    WRITERS,
    CountRule,
    PeriodCount,
    SceneCount,
    assign_points,
    count_scene,
    count_table,
    observation_counts,
    to_csv,
    to_json,
    to_latex,
    to_markdown,
    to_text,
)

__all__ = [
    "COUNT_RULES",
    "WRITERS",
    "CountRule",
    "PeriodCount",
    "SceneCount",
    "assign_points",
    "count_scene",
    "count_table",
    "observation_counts",
    "to_csv",
    "to_json",
    "to_latex",
    "to_markdown",
    "to_text",
]

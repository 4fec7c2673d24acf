"""Presets and options."""

from __future__ import annotations

from typing import Any

import pytest
from fresh_process import loaded_by

from chronogs import SPEC
from chronogs.config import ChronoGSConfig
from chronoscene.errors import ConfigError
from chronoscene.methods import build_config


@pytest.mark.parametrize("preset", SPEC.presets)
def test_every_preset_builds(preset: str) -> None:
    config = build_config(SPEC, preset=preset)
    assert isinstance(config, ChronoGSConfig)


def test_the_paper_preset_is_what_the_official_code_does() -> None:
    config = build_config(SPEC, preset="paper")
    assert config == ChronoGSConfig()
    assert (config.iterations, config.offsets_per_anchor) == (40_000, 10)
    assert (config.base_dim, config.period_dim, config.global_dim) == (16, 16, 32)
    assert (config.voxel_size, config.voxel_unit) == (0.001, "world")
    assert (config.antialiased, config.cooldown) == (False, 0)
    assert config.density_from * config.iterations == 1_500
    assert config.statistics_from * config.iterations == 500


def test_reading_the_specs_imports_nothing_heavy() -> None:
    loaded = loaded_by("import chronogs, baselines.scaffold_gs")
    assert not loaded & {"torch", "numba", "scipy"}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fusion": "product"}, "fusion: expected 'concat' or 'sum', found 'product'"),
        (
            {"voxel_unit": "mile"},
            "voxel_unit: expected 'world', 'training' or 'spacing', found 'mile'",
        ),
        ({"global_heads": ("colour",)}, "global_heads: .*did you mean 'color'"),
        ({"color_lr": (0.1, 0.1, 0.1)}, "color_lr: expected fewer values"),
        ({"period_dim": 1.5}, "period_dim: expected a valid integer, found 1.5"),
        ({"color_lr": (0.1,)}, "color_lr: expected more values"),
        ({"period_dim": -1}, "period_dim: expected a value greater than or equal to 0, found -1"),
        (
            {"merge_share": -1.0},
            "merge_share: expected a value greater than or equal to 0, found -1.0",
        ),
        ({"trim_global": True, "fusion": "sum"}, "trim_global: expected False with fusion=sum"),
        ({"iterations": 0}, "iterations: expected a value greater than 0, found 0"),
        (
            {"voxel_size": -1.0},
            "voxel_size: expected a value greater than or equal to 0, found -1.0",
        ),
        ({"near_plane": -1.0}, "near_plane: expected a value greater than 0, found -1.0"),
        ({"density_interval": 0}, "density_interval: expected a value greater than 0, found 0"),
        ({"density_from": 500.0}, "density_from: expected a value less than or equal to 1, found"),
        ({"density_until": 2e4}, "density_until: expected a value less than or equal to 1, found"),
        ({"unused_share": 1.0}, "unused_share: expected a value less than 1, found 1.0"),
    ],
)
def test_impossible_options_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ChronoGSConfig(**values)


def test_options_from_the_command_line_take_the_type_of_the_default() -> None:
    config = build_config(
        SPEC,
        preset="balanced",
        overrides={"color_lr": "[0.01, 0.001]", "global_heads": '["color"]', "period_dim": "0"},
    )
    assert config.color_lr == (0.01, 0.001)
    assert config.global_heads == ("color",)
    assert config.period_dim == 0

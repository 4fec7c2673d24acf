"""Every choice of every option trains, or is refused in words, before a training or by it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from chronoscene.errors import ConfigError
from chronoscene.fields.config import GRID_OPTIONS, FieldConfig
from chronoscene.harness.contract import tiny_training
from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.methods import build_config, import_object, load_spec, method_names

from .small_fields import SMALL_FIELD

STEPS = 16  # each photo once
FIELD_STEPS = 3
DEEP_STEPS = 4  # of ResNet-18, each of which takes as long as ten others
NEEDS_MORE = {"densification=mcmc", "fusion=sum"}
"""Choices that are refused without another option, whose name the message has."""


def choices(kind: Any) -> Iterator[Any]:
    """Values that an annotation names."""
    origin = get_origin(kind)
    if origin is Literal:
        yield from get_args(kind)
    elif origin is Annotated:
        yield from choices(get_args(kind)[0])
    elif origin in (Union, UnionType):
        for part in get_args(kind):
            yield from choices(part)
    elif kind is bool:
        yield from (False, True)
    elif kind is NoneType:
        yield None


def cases() -> Iterator[Any]:
    """Each choice that preset ``fast`` does not have, and 0 for each number.

    Choices that methods inherit are tested by default for the first of them.
    """
    seen = set()
    for name in method_names():
        spec = load_spec(name)
        usual = build_config(spec, preset="fast")
        for option, kind in get_type_hints(type(usual), include_extras=True).items():
            now = getattr(usual, option)
            for value in choices(kind):
                if value != now:
                    owner = next(c for c in type(usual).__mro__ if option in c.__annotations__)
                    marks = [pytest.mark.slow] if (owner, option, value) in seen else []
                    seen.add((owner, option, value))
                    yield pytest.param(
                        name, option, value, id=f"{name}-{option}={value}", marks=marks
                    )
            if isinstance(now, float) and now:
                marks = pytest.mark.slow
                yield pytest.param(name, option, 0.0, id=f"{name}-{option}=0", marks=marks)


@pytest.mark.parametrize(("name", "option", "value"), tuple(cases()))
def test_every_choice_trains_or_is_refused(
    name: str, option: str, value: Any, tmp_path: Path
) -> None:
    spec = load_spec(name)
    steps, small = STEPS, {}
    if issubclass(import_object(spec.config), FieldConfig):
        steps, small = FIELD_STEPS, SMALL_FIELD | {"samples": 512}
        if value == "frequencies":  # refused beside options of a grid
            small = {name: small[name] for name in small if name not in GRID_OPTIONS}
    elif value == "resnet18":
        steps = DEEP_STEPS
    overrides = {"iterations": steps, **small, option: value}
    try:
        config = build_config(spec, preset="fast", overrides=overrides)
        method = import_object(spec.method)(config)
        data = make_training_set(tiny_training.periods_for(spec))
        method.setup(data, seed=0, device="cpu")
    except ConfigError as refusal:
        assert value == 0 or f"{option}={value}" in NEEDS_MORE
        assert option.removesuffix("_initial").removesuffix("_final") in str(refusal)
        return
    for index in range(steps):
        method.step(index, index / steps)
    method.save(tmp_path)
    loaded = type(method)(config)
    loaded.load(tmp_path, device="cpu")
    images = [m.render(data.views[0], 0.0).rgb for m in (method, loaded)]
    assert np.isfinite(images[0]).all() and np.array_equal(*images)

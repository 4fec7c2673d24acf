"""Presets in files: read back as written, and refused in one line where they do not fit."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.errors import ConfigError
from chronoscene.methods import build_config, load_spec
from chronoscene.methods.preset_files import PresetFile, preset_text, read_preset_file

PRESET = """
method = "3dgs"
base = "fast"

[options]
opacity_lr = 0.02
antialiased = true

[tuning]
scenes = [{ name = "plaza", hash = "1" }]
"""


@pytest.fixture
def preset_file(tmp_path):
    def write(text, name="mine"):
        path = tmp_path / f"{name}.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_options_replace_those_of_the_base(preset_file):
    spec, path = load_spec("3dgs"), str(preset_file(PRESET))
    fast = build_config(spec, preset="fast")
    expected = dataclasses.replace(fast, opacity_lr=0.02, antialiased=True)
    assert build_config(spec, preset=path) == expected
    changed = build_config(spec, preset=path, overrides={"opacity_lr": "0.3"})
    assert changed == dataclasses.replace(expected, opacity_lr=0.3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"3dgs"', '"4dgs"', "expected a preset of 3dgs, found one of 4dgs"),
        ('"fast"', '"fats"', "3dgs --preset: expected one of accurate, balanced, fast, paper"),
        ("opacity_lr", "opacity", "mine.toml: expected one of"),
        ("0.02", "true", "mine.toml opacity_lr: expected a valid number, found True"),
        ("base", "bases", "Field required (base)"),
        ("[options]", "[others]", "Extra inputs are not permitted (others)"),
        ("= true", "=", "Invalid value"),
    ],
)
def test_mistakes_are_named(preset_file, old, new, message):
    path = str(preset_file(PRESET.replace(old, new)))
    with pytest.raises(ConfigError) as caught:
        build_config(load_spec("3dgs"), preset=path)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_names_are_those_of_no_preset(preset_file, tmp_path):
    with pytest.raises(ConfigError, match="another name than presets of 3dgs have, found fast"):
        build_config(load_spec("3dgs"), preset=str(preset_file(PRESET, "fast")))
    with pytest.raises(ConfigError, match="expected a preset file, found No such file"):
        build_config(load_spec("3dgs"), preset=str(tmp_path / "none.toml"))


SCALARS = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(st.characters(exclude_categories=["Cs"])),
)
KEYS = st.from_regex("[a-z_]+", fullmatch=True)
VALUES = st.dictionaries(KEYS, st.one_of(SCALARS, st.lists(SCALARS, max_size=3)), max_size=4)


@given(options=VALUES, tuning=VALUES, scenes=st.lists(VALUES, max_size=2))
def test_what_is_written_is_read(tmp_path_factory, options, tuning, scenes):
    preset = PresetFile(
        method="3dgs", base="fast", options=options, tuning={**tuning, "scenes": scenes}
    )
    path = tmp_path_factory.mktemp("preset") / "mine.toml"
    path.write_text(preset_text(preset), encoding="utf-8", newline="")
    assert read_preset_file(path, load_spec("3dgs")) == preset

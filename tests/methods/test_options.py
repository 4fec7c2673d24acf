"""Method specs are found by name, and configs are built from presets and typed overrides."""

import math
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
from fresh_process import loaded_by
from installed import install

from chronoscene.anchors.config import AnchorConfig
from chronoscene.errors import ConfigError
from chronoscene.methods import MethodSpec, build_config, load_spec, method_names


@dataclass(frozen=True)
class Config:
    iterations: int = 100
    rate: float = 0.5
    name: str = "a"
    flag: bool = False
    sizes: tuple[int, ...] = (1, 2)
    limit: int | None = None


SPEC = MethodSpec(
    name="toy",
    title="Toy",
    paper="none",
    licence="Apache-2.0",
    period_input="none",
    outputs=("rgb",),
    devices=("cpu",),
    method=f"{__name__}:Config",
    config=f"{__name__}:Config",
    presets={"balanced": {}, "fast": {"iterations": 10}},
)


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])


def test_overrides_are_parsed_like_the_default():
    config = build_config(
        SPEC,
        preset="fast",
        overrides={"rate": "1", "flag": "True", "sizes": "[3]", "limit": "7", "name": "12"},
    )
    assert config == Config(10, 1.0, "12", True, (3,), 7)
    assert isinstance(config.rate, float)


@dataclass(frozen=True)
class Idle(Config):
    def without_effect(self):
        return {} if self.flag else {"limit": "flag=true"}


def test_an_option_without_effect_is_refused_where_it_is_given(tmp_path):
    spec = replace(SPEC, config=f"{__name__}:Idle", presets={"fast": {"limit": 7}})
    assert build_config(spec, preset="fast").limit == 7
    assert build_config(spec, preset="fast", overrides={"limit": 3, "flag": True}).limit == 3
    file = tmp_path / "own.toml"
    file.write_text('method = "toy"\nbase = "fast"\n[options]\nlimit = 3\n')
    for given, place in (
        ({"preset": "fast", "overrides": {"limit": "3"}}, "toy --set limit"),
        ({"preset": str(file)}, f"{file} limit"),
    ):
        with pytest.raises(ConfigError) as caught:
            build_config(spec, **given)
        assert str(caught.value).startswith(f"{place}: expected flag=true, without which it has no")


@pytest.mark.parametrize("value", ["[3, 4]", "(3, 4)", "(3,4,)", "[3,4]"])
def test_tuples_are_written_as_in_python_or_json(value):
    assert build_config(SPEC, preset="fast", overrides={"sizes": value}).sizes == (3, 4)


def test_values_may_be_of_numpy_but_not_dates_of_a_preset_file(tmp_path):
    given = {"iterations": np.int64(7), "rate": np.float32(0.25), "sizes": np.array([3, 4])}
    config = build_config(SPEC, preset="fast", overrides=given)
    assert (config.iterations, config.rate, config.sizes) == (7, 0.25, (3, 4))
    (tmp_path / "dated.toml").write_text(
        'method = "toy"\nbase = "fast"\n[options]\nrate = 2020-01-01\n'
    )
    with pytest.raises(ConfigError, match=r"an option: expected text.* found datetime.date\(2020"):
        build_config(SPEC, preset=str(tmp_path / "dated.toml"))


@pytest.mark.parametrize("value", ["fast", "1.5", "true", "[1]"])
def test_values_of_another_type_are_refused(value):
    with pytest.raises(ConfigError, match="toy --set iterations: expected a valid integer, found"):
        build_config(SPEC, preset="fast", overrides={"iterations": value})


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity", math.inf])
def test_numbers_that_no_file_can_hold_are_refused(value):
    """Else the model of a whole training could not be stored."""
    with pytest.raises(ConfigError, match="toy --set rate: expected a finite number, found"):
        build_config(SPEC, preset="fast", overrides={"rate": value})
    with pytest.raises(ConfigError, match="offset_lr: expected a finite number, found inf"):
        AnchorConfig(offset_lr=(math.inf, 1.0))


@dataclass(frozen=True)
class Unreadable:
    iterations: "Sequence[int]" = ()  # noqa: F821


def test_annotations_that_cannot_be_read_are_named():
    spec = replace(SPEC, config=f"{__name__}:Unreadable")
    with pytest.raises(ConfigError, match=r"Unreadable: .* found name 'Sequence' is not defined"):
        build_config(spec, preset="balanced")


def test_unknown_preset_and_key_name_the_known_ones():
    with pytest.raises(ConfigError, match="balanced, fast"):
        build_config(SPEC, preset="best")
    with pytest.raises(ConfigError, match="did you mean 'iterations'"):
        build_config(SPEC, preset="fast", overrides={"iteration": "3"})


def test_unknown_method_names_the_known_ones():
    with pytest.raises(ConfigError, match="chronogs"):
        load_spec("chronosg")
    with pytest.raises(ConfigError, match="expected a MethodSpec"):
        load_spec("json:dumps")


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("no.such:SPEC", "expected an importable module:Name, found No module named 'no'; check"),
        ("whole.part:SPEC", "importable module:Name, found No module named 'whole.part'; 'whole'"),
        ("no.such:SPEC", "; start the command in the folder of the module, or install its package"),
        (":SPEC", "expected an importable module:Name, found Empty module name; check"),
        (".whole:SPEC", "expected an importable module:Name, found the 'package' argument"),
        ("whole:SPECS", "expected a name in the module whole, found none called 'SPECS'; did you"),
        ("whole:", "expected a name in the module whole, found none called ''; define it there"),
        ("needy:SPEC", r"found ModuleNotFoundError: No .* 'no' \(.*needy.py:2\); correct"),
        ("broken:SPEC", r"imported, found NameError: name .* \(.*broken.py:1\); correct bro"),
        ("unread:SPEC", r"imported, found SyntaxError: .* \(unread.py, line 1\); correct unread"),
    ],
)
def test_an_import_that_fails_names_its_cause(reference, message, tmp_path, monkeypatch):
    for name, text in (
        ("whole", "SPEC = 1"),
        ("needy", "\nimport no.such"),
        ("broken", "SPEC = other"),
        ("unread", "SPEC ="),
    ):
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "whole", raising=False)
    with pytest.raises(ConfigError, match=f"^{reference}: .*{message}"):
        load_spec(reference)


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import no_such_package", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("OTHER = 1", "AttributeError: "),
        ("spec = no_such_name", "NameError: "),
    ],
)
def test_an_installed_method_that_cannot_be_imported_is_named(monkeypatch, tmp_path, source, found):
    module = f"plug_in_of_{tmp_path.name}"
    entries = {"broken": f"{module}:SPEC"}
    install(monkeypatch, tmp_path, {module: source}, "chronoscene.methods", entries)
    with pytest.raises(ConfigError, match=r"method broken: .* package plug-in names") as error:
        load_spec("broken")
    assert f"found {found}" in str(error.value)


def test_a_method_of_two_packages_is_neither(monkeypatch, tmp_path):
    entries = {"3dgs": "no_such_package:SPEC"}
    install(monkeypatch, tmp_path, {}, "chronoscene.methods", entries)
    with pytest.raises(ConfigError, match=r"method 3dgs: expected one package .* plug-in.* and "):
        load_spec("3dgs")


def test_listing_methods_imports_nothing_heavy():
    code = (
        "from chronoscene.methods import PROGRAM_GROUP, load_spec, method_names\n"
        "for name in method_names() + method_names(PROGRAM_GROUP): load_spec(name)"
    )
    assert len(method_names()) >= 3
    assert not loaded_by(code) & {"torch", "numba", "cv2", "matplotlib", "pycolmap"}

"""Studies: the file, what is run, and that those which come with methods can be run."""

from dataclasses import asdict
from pathlib import Path

import pytest
from installed import install
from training_here import execute_here

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import read_run
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.study.plan import (
    Study,
    find_study,
    installed_studies,
    read_study,
    run_study,
)
from chronoscene.methods import build_config, load_spec

TWO_ROWS = """
title = "Rates"
question = "Which rate is better?"
method = "toy_methods:MEAN"
source = "A paper"

[[rows]]
label = "slow"
set = { rate = 0.01 }
published.Square = { psnr = 20.0 }

[[rows]]
label = "fast"
set = { rate = 0.5 }
published.Square = { psnr = 25.0, checkpoint_bytes = 1e6 }
"""


@pytest.fixture
def study_file(tmp_path):
    def write(text: str) -> Path:
        path = tmp_path / "rates.toml"
        path.write_text(text)
        return path

    return write


def run(study, scene, tmp_path, **changes):
    fields = {"scenes": (scene,), "methods": (), "runs": tmp_path / "runs", "threads": 1}
    said = []
    settings = bench_settings(**{**fields, **changes})
    return *run_study(study, settings, said.append, execute=execute_here), said


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"Rates"', '"Rates', "(at line 2, column 15)"),
        ("question", "questions", "Field required (question)"),
        ("set = {", "sets = {", "Extra inputs are not permitted (rows.0.sets)"),
        ('"fast"', '"slow"', "labels 'slow', 'slow', which are not all different"),
        ("psnr = 20", "pnsr = 20", "row 'slow': published: expected one of"),
        ("set = { rate = 0.5 }", 'strategy = "join"', "did you mean 'joint'?"),
        ("20.0", '"high"', "(rows.0.published.Square.psnr)"),
    ],
)
def test_mistakes_in_a_file_are_named(study_file, old, new, message):
    path = study_file(TWO_ROWS.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        read_study(path)
    assert str(caught.value).startswith(str(path)) and message in str(caught.value)


def test_the_example_of_the_documentation_is_a_study(study_file):
    text = (Path(__file__).parents[3] / "docs/guides/studies.md").read_text()
    study = read_study(study_file(text.split("```toml")[1].split("```")[0]))
    assert [row.separate_iterations for row in study.rows] == [None, None, "each"]


def test_a_file_that_is_not_there_and_a_name_that_is_unknown(tmp_path):
    with pytest.raises(ConfigError, match="found No such file or directory; correct it"):
        read_study(find_study(str(tmp_path / "none.toml")))
    with pytest.raises(ConfigError, match="did you mean 'components'"):
        find_study("component")


def test_rows_are_run_and_finished_ones_kept(study_file, scene_folder, tmp_path, monkeypatch):
    monkeypatch.setattr("chronoscene.harness.train.worker.warm_up", lambda *args, **options: None)
    study = read_study(study_file(TWO_ROWS))
    shared = {"ballast": "3", "rate": "0.9"}  # the rate of each row wins
    outcome, finished, said = run(study, scene_folder, tmp_path, seeds=(0, 1), overrides=shared)
    assert len(outcome.finished) == 4 and outcome.skipped == 0
    variants = {label: {read_run(f).variant for f in finished[label]} for label in finished}
    assert variants == {"slow": {"rate=0.01,ballast=3"}, "fast": {"ballast=3"}}
    assert len(said) == len(set(said))
    again, same, _ = run(study, scene_folder, tmp_path, seeds=(0, 1), overrides=shared)
    assert again.skipped == 4 and same == finished


def test_a_row_that_cannot_be_run_is_found_before_anything_is_trained(
    study_file, scene_folder, tmp_path
):
    study = read_study(study_file(TWO_ROWS.replace("rate = 0.5", "speed = 1")))
    with pytest.raises(ConfigError, match="speed"):
        run(study, scene_folder, tmp_path)
    assert not list(tmp_path.glob("runs/*/*/seed0"))


def test_rows_that_are_equal_are_refused(study_file, scene_folder, tmp_path):
    study = read_study(study_file(TWO_ROWS.replace("rate = 0.01", "rate = 0.5")))
    with pytest.raises(ConfigError, match="rows 'slow' and 'fast': expected runs of different"):
        run(study, scene_folder, tmp_path)


def test_an_option_for_a_method_that_is_not_in_the_study(study_file, scene_folder, tmp_path):
    study = read_study(study_file(TWO_ROWS))
    with pytest.raises(ConfigError, match="'blind'"):
        run(study, scene_folder, tmp_path, overrides={"blind.rate": "1"})


SHIPPED = {name: read_study(path) for name, path in installed_studies().items()}


PUBLISHED = {name for name, study in SHIPPED.items() if study.source}


def test_a_broken_plug_in_has_no_studies(tmp_path, monkeypatch):
    entries = {"broken": "needs_more.method:SPEC", "gone": "not.there:SPEC"}
    modules = {"needs_more": "import torch_of_tomorrow"}
    install(monkeypatch, tmp_path, modules, "chronoscene.methods", entries)
    assert installed_studies().keys() == SHIPPED.keys()


def test_studies_of_the_paper_come_with_chronogs():
    names = {"components", "initialisation", "joint"}
    assert names | {f"{kind}-length" for kind in ("global", "varying", "base")} == PUBLISHED
    assert all(SHIPPED[name].rows[0].published for name in PUBLISHED)


@pytest.mark.parametrize("name", sorted(SHIPPED.keys() - PUBLISHED))
def test_values_of_released_code_are_those_of_the_preset_named_paper(name):
    """Rows of such a study whose label is marked have values of other releases, or of ours."""
    study = SHIPPED[name]
    spec = load_spec(study.method)
    paper = asdict(build_config(spec, preset="paper"))
    for row in study.rows:
        if "(" not in row.label:
            assert row.options.items() <= paper.items(), row.label


def presets(name: str) -> tuple[str, ...]:
    """Presets that a study is for: other ones have some of the released values already."""
    return ("paper", "fast", "balanced") if name in PUBLISHED else ("fast",)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_rows_have_options_that_exist(name):
    study: Study = SHIPPED[name]
    for row in study.rows:
        spec = load_spec(row.method or study.method)
        for preset in presets(name):
            build_config(spec, preset=preset, overrides=row.options)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_rows_differ_under_each_preset(name):
    """A feature that is trimmed to what the scene requires has one length in all rows."""
    study = SHIPPED[name]
    for preset in presets(name):
        seen = []
        for row in study.rows:
            spec = load_spec(row.method or study.method)
            config = asdict(build_config(spec, preset=preset, overrides=row.options))
            if config.get("trim_global"):
                config["global_dim"] = bool(config["global_dim"])
            assert (row.strategy, spec.name, config) not in seen
            seen.append((row.strategy, spec.name, config))


def test_features_that_are_added_have_one_length():
    """Features may be left out then, but not have lengths of their own (docs/guides/studies.md)."""
    spec = load_spec("chronogs")
    for row in SHIPPED["components"].rows:
        build_config(spec, preset="paper-text", overrides=row.options)
    with pytest.raises(ConfigError, match="of one length"):
        build_config(spec, preset="paper-text", overrides=SHIPPED["base-length"].rows[1].options)


def test_models_without_a_component_train(scene_folder, tmp_path, monkeypatch):
    monkeypatch.setattr("chronoscene.harness.train.worker.warm_up", lambda *args, **options: None)
    outcome, finished, _ = run(
        SHIPPED["components"], scene_folder, tmp_path, preset="fast", iterations=12
    )
    assert not outcome.failures
    sizes = {label: read_run(folder).parameters for label, (folder,) in finished.items()}
    assert len(set(sizes.values())) == len(sizes)

"""Steps that call the rest of the package, without the steps before them."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from surveyed import ToyRun, make_scene, write_photos

from chronoscene.cli.progress import progress_bar
from chronoscene.errors import BackendError
from chronoscene.scene import WorldFrame
from chronoscene.workflow import steps
from chronoscene.workflow.record import Record
from chronoscene.workflow.steps import STEPS, Project, Skipped

REGISTER, SURVEY = STEPS[0], STEPS[-1]


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project whose model is a toy."""
    scene = make_scene(tmp_path / "scene")
    write_photos(scene)
    monkeypatch.setattr(Project, "opened", lambda self: (ToyRun(scene, noise=0.01), scene))
    record = Record(photos={}, options={})
    return Project(tmp_path / "photos", None, tmp_path, {}, record, print, progress_bar)


def test_tie_points_given_by_hand_stay_in_use(project, monkeypatch):
    given = []
    monkeypatch.setattr(steps, "find_captures", lambda captures, table: (captures, table))
    monkeypatch.setattr(steps, "read_captures", lambda *_, **options: SimpleNamespace(notes=[]))

    def register(captures, out, options, *, inspected, **_):
        given.append(options)
        inspected(SimpleNamespace(summary=""))

    monkeypatch.setattr(steps, "register", register)
    REGISTER.make(project)
    assert given[0].tie_points is None
    assert "--tie-points" not in REGISTER.command(project)
    project.scene.mkdir(parents=True)
    log = {"options": {"seed": 3, "tie_points": "my points.csv", "tie_scale": 2.0}}
    (project.scene / "registration_log.json").write_text(json.dumps(log))
    REGISTER.make(project)
    assert given[1] == replace(given[0], tie_points=Path("my points.csv"), tie_scale=2.0)
    assert REGISTER.command(project).endswith("--tie-points 'my points.csv' --tie-scale 2.0")


def test_the_products_of_a_survey_are_found_by_its_summary(project, tmp_path):
    first, *others = SURVEY.make(project)
    assert first == tmp_path / "survey/survey.json"
    names = {path.name for path in others}
    assert {"difference_0_1.png", "surface_after_1.tif", "volumes.csv"} <= names
    assert {first, *others} == set((tmp_path / "survey").iterdir())


def test_without_metres_or_packages_it_is_skipped(project, tmp_path, monkeypatch):
    def missing():
        raise BackendError("survey", expected="laspy", found="none", todo="install it")

    with monkeypatch.context() as patch:
        patch.setattr(steps, "check_packages", missing)
        with pytest.raises(Skipped, match="expected laspy"):
            SURVEY.make(project)
    scene = replace(make_scene(tmp_path / "scene"), world=WorldFrame("unknown"))
    monkeypatch.setattr(Project, "opened", lambda self: (ToyRun(scene), scene))
    with pytest.raises(Skipped, match="the scene has no scale"):
        SURVEY.make(project)
    assert not (tmp_path / "survey").exists()

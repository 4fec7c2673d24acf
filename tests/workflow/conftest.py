"""A project whose steps only write what the real ones would leave behind."""

import json
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from made_runs import write_scored
from PIL import Image

from chronoscene.cli.progress import progress_bar
from chronoscene.errors import RegistrationError
from chronoscene.workflow import run, summary_page
from chronoscene.workflow.run import run_steps, start
from chronoscene.workflow.steps import STEPS, Project, Skipped

LABELS = ("May_2016 & <before>", "2023")


@dataclass
class Fake:
    """Photos, the folder of the steps, and what the steps do."""

    root: Path
    poses: str = "first"
    verdict: str = "pass"
    broken: str = ""
    """Step that fails."""
    trainings: int = 0
    calls: list = field(default_factory=list)

    @property
    def photos(self):
        return self.root / "photos"

    @property
    def captures(self):
        table = self.root / "dates.csv"
        return table if table.exists() else self.photos

    @property
    def out(self):
        return self.root / "out"

    @property
    def html(self):
        return (self.out / "index.html").read_text(encoding="utf-8")

    @property
    def states(self):
        return {k: v["state"] for k, v in self.recorded["steps"].items()}

    @property
    def recorded(self):
        return json.loads((self.out / "steps.json").read_text())

    def go(self, **options):
        """Run the steps; returns what was printed."""
        given = {"preset": "fast", "budget": None, "max_width": 500} | options
        record, changes = start(self.captures, None, self.out, given)
        self.calls.clear()
        said = [changes]
        run_steps(Project(self.captures, None, self.out, given, record, said.append, progress_bar))
        return said

    def make(self, step, project):
        self.calls.append(step)
        if step == self.broken:
            raise RegistrationError("photos", expected="a model", found="none", todo="add <photos>")
        if step == "survey":
            raise Skipped("the scene has no scale")
        return getattr(self, step)(project)

    def register(self, project):
        scene = project.scene
        (scene / "sparse/0").mkdir(parents=True, exist_ok=True)
        (scene / "sparse/0/images.bin").write_text(self.poses)
        judged = {"verdict": self.verdict, "text": "In <words>."}
        periods = [{"label": name, "photos": 8, "registered": 7} for name in LABELS]
        data = {"alignment": judged, "absolute_position": judged, "periods": periods}
        (scene / "registration.json").write_text(json.dumps(data))
        names = "registration.html", "registration.json", "sparse/0/images.bin"
        (scene / names[0]).touch()
        return [scene / name for name in names]

    def validate(self, project):
        return [self._file(project.fresh("validate") / "index.html")]

    def bench(self, project):
        labels = dict(zip("01", LABELS, strict=True))
        self.trainings += 1
        fields = {"scene": project.out.name, "period_labels": labels, "iterations": self.trainings}
        folder = write_scored(project.out / "bench", "chronogs", **fields)
        return [folder / "run.json"]

    def page(self, project):
        out = project.fresh("page")
        files = [self._file(out / "index.html")]
        for i in range(2):
            files.append(out / f"period-{i}.png")
            Image.fromarray(np.full((6, 8, 3), 90 * i, np.uint8)).save(files[-1])
        return files

    def export(self, project):
        return [self._file(project.fresh("export") / "2023 & more.ply")]

    def _file(self, path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("content")
        return path


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """The fake project; all of its steps are in the tables of the modules."""
    made = Fake(tmp_path)
    for name in ("2016/1.jpg", "2016/2.jpg", "2023/1.jpg"):
        made._file(made.photos / name)

    steps = tuple(replace(step, make=partial(made.make, step.name)) for step in STEPS)
    monkeypatch.setattr(run, "STEPS", steps)
    monkeypatch.setattr(summary_page, "STEPS", steps)
    return made

"""Real photos of a generated city go through all steps, and a second call keeps everything."""

import shutil

import pytest
from command_line import invoke

from chronoscene.formats import read_scene
from chronoscene.harness.files.records import run_folders
from chronoscene.synth import SynthSettings, generate

SETTINGS = SynthSettings(
    periods=2, width=400, height=300, views=12, points=1000, blocks=2, supersample=1
)


@pytest.mark.slow
def test_from_photos_to_products(tmp_path):
    generate(tmp_path / "city", SETTINGS)
    city = read_scene(tmp_path / "city")
    for frame in city.frames:
        photo = tmp_path / "photos" / ("2016", "2023")[frame.period] / frame.name
        photo.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(city.image_path(frame), photo)
    places = tmp_path / "photos", tmp_path / "out"
    command = ["all", *places, "--budget", "5s", "--max-width", 100]
    done = invoke(*command)
    assert "[5/6] export: done in" in done.output, done.output
    assert "[6/6] survey: skipped, the scene has no scale" in done.output
    out = tmp_path / "out"
    assert len(run_folders(next((out / "bench").iterdir()))) == 1
    for name in ("index.html", "page/index.html", "page/period-1.png", "export/2023.ply"):
        assert (out / name).is_file(), name
    again = invoke(*command)
    assert again.output.count(": kept, made in") == 5

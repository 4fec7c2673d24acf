"""``chronoscene score-images`` on images that a script of ten lines writes."""

import json
from functools import partial

import pytest
from command_line import invoke
from PIL import Image

from chronoscene.errors import ConfigError

IMAGES = {f"{folder}/{i}.png": period for period, folder in enumerate("ab") for i in range(3)}
TESTS = ["a/1.png", "b/1.png"]


run = partial(invoke, "score-images")


def test_a_folder_of_images_gets_a_row(make_scene_folder, tmp_path):
    scene, runs = make_scene_folder(IMAGES, tests=TESTS), tmp_path / "runs"
    for view in TESTS:  # the photos themselves: no program can be better
        image = Image.open(scene / "images" / view)
        (tmp_path / "mine" / view).parent.mkdir(parents=True)
        image.save(tmp_path / "mine" / view)
    done = run(scene, tmp_path / "mine", "--name", "The Photos", "--out", runs)
    assert done.exit_code == 0, done.output
    assert "The Photos (external, images)" in done.stdout
    assert str(runs / "figures/scene_comparison.png") in done.stdout
    (record,) = json.loads((runs / "results.json").read_text())
    assert record["aggregates"]["worst"]["psnr"] == "Infinity" and record["seconds"] is None


def test_nothing_is_written_into_the_scene(make_scene_folder, tmp_path):
    scene = make_scene_folder(IMAGES, tests=TESTS)
    with pytest.raises(ConfigError, match="expected a place outside the scene"):
        run(scene, tmp_path, "--name", "x", "--out", scene / "runs")
    with pytest.raises(ConfigError, match="expected a folder without the scene"):
        run(scene, tmp_path, "--name", "x", "--out", scene.parent)

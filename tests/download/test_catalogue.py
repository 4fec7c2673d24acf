"""The table of datasets says what is true of this program."""

import pytest

from chronoscene.download.catalogue import DATASETS
from chronoscene.download.datasets import find_scenes
from chronoscene.formats import format_names


@pytest.mark.parametrize("dataset", DATASETS.values(), ids=str)
def test_formats_exist_and_hosts_are_known(dataset):
    assert dataset.format in format_names()
    assert bool(dataset.repo) == bool(dataset.scene_file)
    assert dataset.licence and dataset.citation and dataset.by_hand
    assert dataset.repo in dataset.page


@pytest.mark.parametrize(
    ("name", "paths", "scenes"),
    [
        (
            "chronoscene",
            ["real/Canteen/sparse/split.txt", "Canteen/sparse/0/images.bin", "TriPlot/split.txt"],
            {"Canteen": "real/Canteen/"},
        ),
        ("chronoscene", ["sparse/split.txt", "images/a.png"], {"whole": ""}),
        (
            "chronoscene",
            ["full/A/sparse/split.txt", "half/A/sparse/split.txt", "half/B/sparse/split.txt"],
            {"full_A": "full/A/", "half_A": "half/A/", "B": "half/B/"},
        ),
        (
            "wat",
            [
                "WAT/spa/sparse/0/images.bin",
                "WAT/mac/sparse/0/images.bin",
                "WAT/mac/images/a/1.png",
            ],
            {"mac": "WAT/mac/", "spa": "WAT/spa/"},
        ),
        (
            "cl-splats",
            [
                "Blender-Levels/Level-1/transforms_train.json",
                "Blender-Levels/Level-1/add/transforms_train.json",
                "Real-World/cone/t0/images/0.png",
                "Real-World/cone/t1/sparse/0/images.bin",
            ],
            {"Level-1": "Blender-Levels/Level-1/", "cone": "Real-World/cone/"},
        ),
    ],
)
def test_scenes_are_known_by_a_file_at_any_depth(name, paths, scenes):
    assert find_scenes(DATASETS[name], paths, "whole") == scenes

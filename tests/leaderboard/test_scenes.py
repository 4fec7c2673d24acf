"""Scenes with a role are apart from each other, and are made as the table says."""

from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from chronoscene.errors import SceneError
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.scene.splits import split_hash
from chronoscene.synth import SynthSettings, preset
from leaderboard import scenes
from leaderboard.scenes import ROLES, FixedScene, fixed_scenes, main, make, meaning_of, role_of

TABLE = fixed_scenes()


def test_no_two_scenes_share_a_hash_or_a_seed():
    for values in (
        [scene.scene_hash for scene in TABLE.values()],
        [scene.split_hash for scene in TABLE.values()],
        [SynthSettings(**scene.synth).seed for scene in TABLE.values() if scene.synth],
    ):
        assert max(Counter(values).values()) == 1
    assert {scene.role for scene in TABLE.values()} <= {*ROLES}
    assert all(bool(scene.synth) != bool(scene.made) for scene in TABLE.values())


def test_the_page_of_scenes_has_their_hashes():
    page = Path(scenes.__file__).parents[1] / "docs/reference/scenes.md"
    rows = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    for name, scene in TABLE.items():
        (row,) = [row for row in rows if row.startswith(f"| `{name}`")]
        assert f"`{scene.scene_hash[:10]}` | `{scene.split_hash[:10]}`" in row
        assert scene.about in row and scene.role in row


def test_roles_are_told_by_hash():
    assert "no trial" in meaning_of(role_of(TABLE["ranking-aerial"].scene_hash))
    assert "without a role" in meaning_of(role_of("0" * 64))


@pytest.fixture
def table(monkeypatch, tmp_path) -> dict[str, FixedScene]:
    """A table of one tiny scene, made once, and one that is made by hand."""
    settings = asdict(preset("tiny", views=4, points=100, seed=5))
    tiny = FixedScene("tuning", "tiny", "0" * 64, "0" * 64, "0" * 64, synth=settings)
    with pytest.raises(SceneError, match="expected scene 0000000000, split 0000000000, found"):
        make(tmp_path / "tiny", tiny)
    scene = read_scene(tmp_path / "tiny")
    tiny = replace(tiny, scene_hash=scene_hash(scene), split_hash=split_hash(scene))
    hand = FixedScene(
        "ranking", "by hand", "1" * 64, "1" * 64, "1" * 64, made="register the photos"
    )
    table = {"tiny": tiny, "hand": hand}
    monkeypatch.setattr(scenes, "fixed_scenes", lambda: table)
    return table


def test_scenes_are_made_again_checked_and_told_apart(table, tmp_path, capsys):
    folder = str(tmp_path / "new")
    assert main([folder]) == 0
    assert "new/tiny: a tuning scene" in capsys.readouterr().out
    image = next((tmp_path / "new/tiny/images").iterdir())
    image.write_bytes(image.read_bytes() + b"\0")
    assert main([folder, "tiny", "hand", "other"]) == 1
    said = capsys.readouterr()
    assert not said.out
    differs, absent, unknown = said.err.splitlines()
    assert "other pixels" in differs
    assert "new/hand: expected this scene, found nothing there; register the photos" in absent
    assert "expected one of hand, tiny, found 'other'" in unknown
    assert main([folder, "--role", "ranking"]) == 0  # which has no generated scene


def test_a_role_is_no_choice_among_names(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path / "new"), "demo", "--role", "ranking"])
    assert "leave out either it or the names" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_a_ranking_scene_is_the_one_of_the_table(tmp_path):
    make(tmp_path / "ranking-street", TABLE["ranking-street"])

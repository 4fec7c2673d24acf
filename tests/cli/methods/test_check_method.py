"""``check-method`` and ``new-method``: the example is installed, copied and checked."""

import os
import subprocess
import sys

import pytest
from command_line import invoke

from chronoscene.cli.methods.check_method import SKELETON
from chronoscene.errors import ConfigError, SceneError
from chronoscene.harness.contract import RuleResult


def texts(folder):
    kinds = ("*.py", "*.toml", "*.md")
    found = [path for kind in kinds for path in folder.rglob(kind)]
    return {path.relative_to(folder).as_posix(): path.read_text() for path in found}


def test_a_new_method_is_the_example_with_another_name(tmp_path):
    assert invoke("new-method", "tinted-gaussians", "--out", tmp_path / "same").exit_code == 0
    assert texts(tmp_path / "same") == texts(SKELETON)
    result = invoke("new-method", "my-own-idea", "--out", tmp_path / "new")
    assert "chronoscene check-method my-own-idea\n" in result.stdout
    new = texts(tmp_path / "new")
    assert sorted(new) == [
        "README.md", "my_own_idea/__init__.py", "my_own_idea/method.py", "pyproject.toml",
    ]  # fmt: skip
    assert 'my-own-idea = "my_own_idea:SPEC"' in new["pyproject.toml"]
    assert 'title="My Own Idea"' in new["my_own_idea/__init__.py"]
    assert "class MyOwnIdea(GaussianMethod)" in new["my_own_idea/method.py"]
    assert "inted" not in "".join(new.values())


def test_the_command_to_install_names_a_folder_with_blanks_as_a_shell_takes_it(tmp_path):
    result = invoke("new-method", "mine", "--out", tmp_path / "a b")
    assert f"pip install --editable '{tmp_path}/a b'\n" in result.stdout


def test_wrong_names_and_places_are_refused(tmp_path):
    for name in ("My-Method", "3dgs", "a_b", "a-"):
        with pytest.raises(ConfigError, match="a small letter, then small letters and digits"):
            invoke("new-method", name, "--out", tmp_path / "new")
    for name in ("class", "torch", "chronogs"):
        with pytest.raises(ConfigError, match=f"'{name}', which the package would hide"):
            invoke("new-method", name, "--out", tmp_path / "new")
    (tmp_path / "used").mkdir()
    (tmp_path / "used/file").touch()
    with pytest.raises(SceneError, match="new or empty folder"):
        invoke("new-method", "mine", "--out", tmp_path / "used")


def test_the_example_is_short_installs_and_is_found(tmp_path):
    pytest.importorskip("setuptools")
    assert not SKELETON.is_symlink()  # some checkouts have a file in the place of a link
    assert sum(len(p.read_text().splitlines()) for p in SKELETON.rglob("*.py")) < 100
    package = tmp_path / "package"  # pip leaves files beside what it builds
    assert invoke("new-method", "tinted-gaussians", "--out", package).exit_code == 0
    options = ["--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--quiet"]
    site = tmp_path / "site"
    command = [sys.executable, "-m", "pip", "install", *options, "--target", site, package]
    subprocess.run(command, check=True, capture_output=True)
    done = subprocess.run(
        [sys.executable, "-m", "chronoscene", "methods", "tinted-gaussians"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *filter(None, sys.path)])},
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.stdout.startswith("Tinted Gaussians (tinted-gaussians)\n"), done.stderr
    assert "tint_lr=0.01\n    Learning rate of the tints." in done.stdout


def test_rules_are_told_line_by_line(monkeypatch):
    def findings(name):
        yield RuleResult("It trains")
        yield RuleResult("It resumes", left_out="the method cannot be resumed")
        yield RuleResult("It saves", problem="save: expected two files, found one")

    monkeypatch.setattr("chronoscene.harness.contract.check_method", findings)
    result = invoke("check-method", "mine")
    assert result.exit_code == 1
    assert result.stdout.splitlines() == [
        "ok      It trains",
        "-       It resumes: the method cannot be resumed",
        "FAILED  It saves",
        "        save: expected two files, found one",
        "mine: 1 of 3 rules broken",
    ]

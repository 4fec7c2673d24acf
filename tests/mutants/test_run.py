"""The planted bugs: that they fit the code, and what is said of them."""

from pathlib import Path

import pytest
from mutants import run
from mutants.run import ROOT, Mutant, StaleError, read_mutants


@pytest.mark.parametrize("mutant", read_mutants(), ids=lambda mutant: mutant.name)
def test_the_code_of_each_bug_is_there_once(mutant: Mutant) -> None:
    assert mutant.planted(ROOT) != (ROOT / mutant.path).read_text(encoding="utf-8")
    for test in mutant.tests:
        path, *names = test.split("::")
        text = (ROOT / path).read_text(encoding="utf-8")
        assert all(f"def {name}(" in text for name in names), test


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # they take most of the time
    (tmp_path / "half.py").write_text("def half(x):\n    return x / 2\n")
    (tmp_path / "test_half.py").write_text(
        "from half import half\n\n\ndef test_half():\n    assert half(4) == 2\n"
    )
    return tmp_path


def bug(after: str, before: str = "x / 2") -> Mutant:
    return Mutant(after, "half.py", before, after, ("test_half.py",))


def test_what_is_not_caught_is_returned(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alive = run.survivors(project, [bug("x - 2"), bug("x / 3")])
    assert [mutant.name for mutant in alive] == ["x - 2"]
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["survived", "caught"]
    assert "x / 2" in (project / "half.py").read_text()


@pytest.mark.parametrize(("before", "count"), [("x / 4", 0), ("x", 2)])
def test_a_bug_that_does_not_fit_is_named(project: Path, before: str, count: int) -> None:
    with pytest.raises(
        StaleError, match=rf"y: expected '{before}' once in half\.py, found {count}"
    ):
        run.survivors(project, [bug("y", before)])


def test_tests_that_fail_anyhow_prove_nothing(project: Path) -> None:
    (project / "half.py").write_text("def half(x):\n    return x / 2 + 1\n")
    with pytest.raises(StaleError, match="do not pass without a bug"):
        run.survivors(project, [bug("x / 3")])


def test_tests_end_at_their_limit(project: Path) -> None:
    assert run.run_tests(project, ["test_half.py"], 0.05) is None

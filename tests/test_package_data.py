"""Files other than modules that the packages read: an installed wheel has them, too."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_package_data_lists_every_file_that_is_no_module() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    listed, found = set(), set()
    for package, patterns in settings["package-data"].items():
        listed |= {path for pattern in patterns for path in (ROOT / package).glob(pattern)}
        found |= {path for path in (ROOT / package).rglob("*") if path.is_file()}
    missing = {
        path
        for path in found - listed
        # READMEs of methods are for readers of the repository; the skeleton's is part of it.
        if path.suffix != ".py"
        and "__pycache__" not in path.parts
        and (path.name != "README.md" or "cli" in path.parts)
    }
    assert len(listed) > 100
    assert not missing, "add to package-data in pyproject.toml"

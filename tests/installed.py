"""Packages that look installed: modules with the entry points that pip would have written."""

from importlib import invalidate_caches
from pathlib import Path


def install(monkeypatch, folder: Path, modules: dict, group: str, entries: dict) -> None:
    """Make modules importable from a folder, with entry points of a group."""
    for name, source in modules.items():
        (folder / f"{name}.py").write_text(source)
    info = folder / "plug_in-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plug-in\nVersion: 1.0\n")
    lines = "".join(f"{name} = {value}\n" for name, value in entries.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n{lines}")
    monkeypatch.syspath_prepend(folder)
    invalidate_caches()

"""chronoscene doctor: the table, what to install, and the exit status."""

import subprocess
import sys
from functools import partial
from importlib.machinery import ModuleSpec
from importlib.metadata import metadata

import pytest
from command_line import invoke

from chronoscene import __version__
from chronoscene.cli import doctor

run = partial(invoke, "doctor")


def rows(text):
    table = text.split("\n\n")[0].splitlines()[3:]
    return {line[:13].strip(): line[15:].split(maxsplit=1) for line in table}


@pytest.fixture
def bare(monkeypatch, tmp_path, set_gsplat):
    """A machine without anything that is optional."""
    set_gsplat(None)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.delenv("CHRONOSCENE_LPIPS_WEIGHTS", raising=False)
    monkeypatch.setattr("chronoscene.metrics.lpips_weights.find_spec", lambda name: None)
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    return tmp_path


def test_bare_machine_trains_and_is_told_what_to_install(bare):
    result = run()
    found = rows(result.stdout)
    assert result.exit_code == 0
    assert found["chronoscene"][1].startswith(f"{__version__}, Python 3.")
    assert {part for part, (state, _) in found.items() if state == "missing"} == {
        "CUDA",
        "gsplat",
        "LPIPS weights",
        "video",
        "extras",
    }
    assert "compiled once and kept in" in found["kernels"][1]
    assert found["memory"][1].endswith("GB") and found["disk"][1].endswith("free here")
    for advice in (
        "CUDA: not needed: methods are trained on the CPU",
        "gsplat: pip install 'chronoscene[cuda]', or use the CPU",
        "LPIPS weights: run chronoscene download lpips-weights",
        "extras: pip install 'chronoscene[compress,flip,heic,hloc,ray,survey,tune,view]'",
    ):
        assert f"\n{advice}" in result.stdout


def test_every_extra_has_a_row():
    known = metadata("chronoscene").get_all("Provides-Extra")
    assert {*doctor.EXTRAS, "cuda", "lpips"} == set(known)


def test_full_machine(bare, monkeypatch, set_gsplat):
    (bare / "hub/checkpoints").mkdir(parents=True)
    (bare / "hub/checkpoints/vgg16-397923af.pth").write_bytes(bytes(1_000_001))
    device = type("", (), {"name": "GPU 1", "total_memory": 8e10})
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr("torch.cuda.get_device_properties", lambda number: device)
    monkeypatch.setattr(doctor, "find_spec", lambda name: ModuleSpec(name, None))
    monkeypatch.setattr(doctor, "version", lambda name: "1.5.3")
    monkeypatch.setattr(doctor.gpu, "has_triton", lambda: True)
    set_gsplat("1.5.3")
    found = rows(run().stdout)
    assert found["CUDA"] == ["ok", "GPU 1, 80.0 GB, triton 1.5.3"]
    assert found["gsplat"] == ["ok", "gsplat 1.5.3"]
    assert found["extras"] == ["ok", "compress, flip, heic, hloc, ray, survey, tune, view"]
    assert found["LPIPS weights"][1].endswith("vgg16-397923af.pth")
    monkeypatch.setattr(doctor.gpu, "has_triton", lambda: False)
    text = run().stdout
    assert rows(text)["CUDA"] == ["ok", "GPU 1, 80.0 GB, no triton"]
    assert "CUDA: pip install triton" in text


def test_a_gsplat_of_another_version_is_not_ok(bare, set_gsplat):
    set_gsplat("1.4.0")
    found = rows(run().stdout)
    assert found["gsplat"] == ["missing", "1.4.0, not version 1.5 or 1.6"]


@pytest.mark.parametrize(
    "modules", [{"torch": "torch"}, {"numba": "kernels", "pycolmap": "COLMAP"}], ids=", ".join
)
def test_works_without_what_training_needs(modules):
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({[*modules]}))\n"
        "sys.argv = ['chronoscene', 'doctor']\n"
        "from chronoscene.cli import main; main()"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 1 and not result.stderr
    needed = {part for part, (state, _) in rows(result.stdout).items() if state == "needed"}
    assert needed == set(modules.values())
    for module, part in modules.items():
        assert f"\n{part}: pip install {module}" in result.stdout
    assert result.stdout.endswith("commands on datasets may work.\n")


def test_kernels_that_cannot_be_kept(monkeypatch):
    def without_a_cache(function):
        from numba import njit

        return njit(function)

    monkeypatch.setattr("chronoscene.kernels.compilation.kernel", without_a_cache)
    result = run()
    assert result.exit_code == 0 and rows(result.stdout)["kernels"][0] == "missing"
    assert "kernels: set NUMBA_CACHE_DIR to such a folder" in result.stdout

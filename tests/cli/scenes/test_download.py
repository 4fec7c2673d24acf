"""chronoscene download: what it prints, and how it fails."""

import subprocess
import sys
from dataclasses import replace
from functools import partial

import pytest
from click.testing import CliRunner
from command_line import invoke
from hub_standin import serving

from chronoscene.cli import cli
from chronoscene.download import weights
from chronoscene.download.catalogue import DATASETS
from chronoscene.errors import ConfigError, DownloadError
from chronoscene.metrics.lpips_weights import ENVIRONMENT

CHRONOSCENE = DATASETS["chronoscene"]


run = partial(invoke, "download")


@pytest.fixture
def hub(monkeypatch, make_scene_folder):
    """A stand-in of the hub with one scene."""
    folder = make_scene_folder(name="source")
    files = {f"Canteen/{p.relative_to(folder)}": p for p in folder.rglob("*") if p.is_file()}
    content = {name: path.read_bytes() for name, path in files.items()}
    with serving(CHRONOSCENE.repo, content) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        yield server


def test_downloads_a_scene_that_is_valid(hub, tmp_path):
    out = tmp_path / "data"
    result = run("chronoscene", "Canteen", "--out", out)
    assert result.exit_code == 0
    said, *after = result.stdout.splitlines()
    assert said.startswith("ChronoScene: ") and f"kB in {len(hub.files)} files" in said
    assert after == [
        "licence: Apache-2.0 (https://huggingface.co/datasets/wangzhongtao/ChronoScene)",
        f"cite: {CHRONOSCENE.citation}",
        f"next: chronoscene validate {out}",
    ]
    for step in ("list https://huggingface.co/datasets/", "MB downloaded", "files checked"):
        assert step in result.stderr
    assert invoke("validate", out).exit_code == 0


def test_default_folder_is_named_for_the_dataset(hub, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("chronoscene").exit_code == 0
    assert (tmp_path / "data/chronoscene/Canteen/sparse/split.txt").is_file()


def test_failure_says_the_way_by_hand(hub, tmp_path):
    hub.damaged = {"Canteen/sparse/split.txt"}
    code = (
        "import sys; sys.modules['torch'] = None\n"  # not needed
        f"sys.argv[1:] = ['download', 'chronoscene', '--out', {str(tmp_path)!r}]\n"
        "from chronoscene.cli import main; main()"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 2
    by_hand, error = result.stderr.splitlines()[-2:]
    assert by_hand == f"by hand: {CHRONOSCENE.by_hand}"
    assert error.startswith(f"error: {tmp_path}/.download: expected files with the checksums")


def test_other_hosts_are_for_people():
    result = run("5pointz")
    assert result.exit_code == 1
    assert "5Pointz (NeuSC) is on Google Drive. By hand: pip install gdown" in result.stdout
    assert "next: chronoscene validate 5pointz\n" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["5pointz", "--out", "data"], "--out: expected no such option with 5pointz, which only"),
        (["5pointz", "wall"], "scenes: expected no such argument with 5pointz, which only"),
        (["--out", "data"], "--out: expected no such option without NAME"),
    ],
)
def test_arguments_without_effect_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        run(*arguments)


def test_lists_what_there_is():
    lines = run().stdout.splitlines()
    assert [line.split()[0] for line in lines[3:]] == [*DATASETS, "lpips-weights"]
    assert "Apache-2.0" in lines[3] and lines[3].endswith("chronoscene")


def test_weights(monkeypatch, tmp_path):
    with serving("a/b", {"vgg.pth": b"heads"}) as hub:
        url = f"{hub.url}/datasets/a/b/resolve/0123456789abcdef0123456789abcdef01234567/vgg.pth"
        file = replace(weights.LPIPS_WEIGHTS[1], url=url, size=5)
        monkeypatch.setattr(weights, "LPIPS_WEIGHTS", [file])
        failed = CliRunner().invoke(cli, ["download", "lpips-weights", "--out", str(tmp_path)])
        blob = hub.entries()[0]["oid"]
        monkeypatch.setattr(weights, "LPIPS_WEIGHTS", [replace(file, checksum=blob)])
        result = run("lpips-weights", "--out", tmp_path)
        monkeypatch.setenv("TORCH_HOME", str(tmp_path))
        elsewhere = run("lpips-weights")
    assert isinstance(failed.exception, DownloadError)
    by_hand = failed.stderr.splitlines()[-1]
    assert by_hand.startswith(
        "by hand: save https://download.pytorch.org/models/vgg16-397923af.pth"
    )
    assert by_hand.endswith(f"vgg.pth in a folder and set {ENVIRONMENT} to it")
    assert f"LPIPS weights are in {tmp_path}\nnext: give {tmp_path} as" in result.stdout
    assert elsewhere.stdout == f"LPIPS weights are in {tmp_path}/hub/checkpoints\n"


def test_weights_have_no_scenes():
    with pytest.raises(ConfigError, match="expected no scenes, found Canteen"):
        run("lpips-weights", "Canteen")

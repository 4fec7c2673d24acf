"""Models on disk."""

import json

import numpy as np
import pytest
import torch
from safetensors import SafetensorError

from chronoscene.errors import CheckpointError, DiskFullError
from chronoscene.scene.similarity import Sim3
from chronoscene.training.checkpoint import META_FILE, TENSOR_FILE, load_tensors, save_tensors


def example():
    generator = torch.Generator().manual_seed(0)
    whole = torch.randn(6, 4, generator=generator)
    tensors = {"zeta": whole.T, "alpha": whole[1:3], "half": whole.half(), "index": torch.arange(5)}
    frame = Sim3(0.5, np.eye(3), np.array([1.0, 2.0, 3.0]))
    meta = {
        "method": "toy",
        "config": {"iterations": 7, "rate": 0.1},
        "training_from_world": frame.to_matrix().tolist(),
        "num_periods": 3,
        "note": "a",
    }
    return tensors, meta


def test_round_trip(tmp_path):
    tensors, meta = example()
    save_tensors(tmp_path, tensors, meta)
    loaded, loaded_meta = load_tensors(tmp_path, method="toy")
    assert loaded.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert loaded[name].dtype == tensor.dtype
        assert torch.equal(loaded[name], tensor)
    assert loaded_meta["config"] == {"iterations": 7, "rate": 0.1}
    assert loaded_meta["num_periods"] == 3 and loaded_meta["note"] == "a"
    frame = Sim3.from_matrix(loaded_meta["training_from_world"])
    assert frame.scale == pytest.approx(0.5) and frame.translation.tolist() == [1, 2, 3]
    assert sorted(p.name for p in tmp_path.iterdir()) == [META_FILE, TENSOR_FILE]


def test_equal_models_give_equal_bytes_whatever_the_order(tmp_path):
    tensors, meta = example()
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    save_tensors(tmp_path / "a", tensors, meta)
    turned = {name: tensors[name].clone() for name in reversed(tensors)}
    save_tensors(tmp_path / "b", turned, dict(reversed(meta.items())))
    for name in (TENSOR_FILE, META_FILE):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"model\.json: expected .*found no such file"):
        load_tensors(tmp_path)
    save_tensors(tmp_path, *example())
    (tmp_path / TENSOR_FILE).unlink()
    with pytest.raises(CheckpointError, match=r"model\.safetensors: .*found no such file"):
        load_tensors(tmp_path)


@pytest.mark.parametrize("damage", ["truncated", "flipped"])
def test_damaged_tensors_are_refused(tmp_path, damage):
    save_tensors(tmp_path, *example())
    path = tmp_path / TENSOR_FILE
    content = bytearray(path.read_bytes())
    if damage == "truncated":
        del content[-8:]
    else:
        content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        load_tensors(tmp_path)


def test_a_file_that_is_no_safetensors_is_refused(tmp_path):
    save_tensors(tmp_path, *example())
    import hashlib

    (tmp_path / TENSOR_FILE).write_bytes(b"\x80\x04pickle")
    meta = json.loads((tmp_path / META_FILE).read_text())
    meta["tensors_sha256"] = hashlib.sha256(b"\x80\x04pickle").hexdigest()
    (tmp_path / META_FILE).write_text(json.dumps(meta))
    with pytest.raises(CheckpointError, match="expected a safetensors file"):
        load_tensors(tmp_path)


@pytest.mark.parametrize("text", ["{", "[]", "{}", "\udcff"])
def test_damaged_description_is_refused(tmp_path, text):
    save_tensors(tmp_path, *example())
    (tmp_path / META_FILE).write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(CheckpointError, match=r"model\.json"):
        load_tensors(tmp_path)


def test_another_method_and_another_version_are_refused(tmp_path):
    tensors, meta = example()
    save_tensors(tmp_path, tensors, meta)
    with pytest.raises(CheckpointError, match="expected a model of 3dgs, found one of toy"):
        load_tensors(tmp_path, method="3dgs")
    document = json.loads((tmp_path / META_FILE).read_text())
    document["format_version"] = 99
    (tmp_path / META_FILE).write_text(json.dumps(document))
    with pytest.raises(CheckpointError, match="format_version 1, found 99"):
        load_tensors(tmp_path)


def test_nan_in_the_description_is_refused_before_it_is_written(tmp_path):
    tensors, meta = example()
    with pytest.raises(ValueError, match="JSON"):
        save_tensors(tmp_path, tensors, {**meta, "loss": float("nan")})
    assert not (tmp_path / META_FILE).exists()


def test_a_full_disk_is_told_as_such(tmp_path, monkeypatch):
    def full(tensors, path):
        path.write_bytes(b"half")
        raise SafetensorError(
            "Error while serializing: I/O error: No space left on device (os error 28)"
        )

    monkeypatch.setattr("chronoscene.training.checkpoint.save_file", full)
    with pytest.raises(DiskFullError, match=r"model\.safetensors: expected space for what is"):
        save_tensors(tmp_path, {"a": torch.zeros(1)}, {})
    assert list(tmp_path.iterdir()) == []

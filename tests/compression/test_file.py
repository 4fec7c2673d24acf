"""Files of compressed models: what comes back, how large they are, and damage."""

import lzma
import sys
import zlib
from contextlib import suppress
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chronoscene.compression.columns import Columns
from chronoscene.compression.file import HEAD, MAGIC, VERSION, decode, encode
from chronoscene.compression.positions import Grid, morton
from chronoscene.errors import CheckpointError, ConfigError

CELL = 0.037


def model(rows=700):
    """Tensors as an anchor method stores them, sorted; their grid, and rules for rounding."""
    rng = np.random.default_rng(0)
    cells = np.unique(rng.integers(-60, 90, (rows, 3)) * [1, 1, 0], axis=0)
    anchors = (cells * CELL).astype(np.float32)
    grid = Grid.of(anchors, CELL)
    anchors = anchors[np.argsort(morton(grid.codes(anchors)))]
    rows = len(anchors)
    mixed = rng.standard_normal((rows, 12)) @ rng.standard_normal((12, 12))
    tensors = {
        "anchors": anchors,
        "changing_anchors": np.sort(rng.choice(9000, rows, replace=False)).astype(np.int32),
        "features": mixed.astype(np.float32),
        "head.w1": rng.standard_normal((32, 20)).astype(np.float32),
        "log_scales": rng.standard_normal((rows, 2, 3)).astype(np.float32),
        "nothing": np.zeros((1, 0), np.float32),
        "used_offsets": rng.integers(1, 32, rows).astype(np.int32),
    }
    rules = {n: Columns.of(tensors[n].reshape(rows, -1)) for n in ("features", "log_scales")}
    return tensors, {"anchors": grid}, rules


@cache
def coded():
    pytest.importorskip("constriction", reason="coded models need constriction")
    return encode(*model())


@cache
def plain():
    tensors, grids, _ = model()
    return encode(tensors, grids, None)


def test_the_plain_form_keeps_half_floats_and_places_on_the_grid():
    tensors, _, _ = model()
    decoded = decode(plain())
    assert decoded.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert decoded[name].dtype == tensor.dtype
        expected = tensor.astype(np.float16) if tensor.dtype == np.float32 else tensor
        if name == "anchors":
            np.testing.assert_allclose(decoded[name], tensor, rtol=0, atol=1e-6)
        else:
            np.testing.assert_array_equal(decoded[name], expected.astype(tensor.dtype))


def test_numbers_that_halves_cannot_hold_stay_as_they_are():
    tensors = {"wide": np.array([1.0, 1e6], np.float32)}
    np.testing.assert_array_equal(decode(encode(tensors, {}, None))["wide"], tensors["wide"])


def test_rounded_numbers_are_half_a_step_away_at_most():
    tensors, _, rules = model()
    decoded = decode(coded())
    for name, rule in rules.items():
        before, after = (t[name].reshape(-1, len(rule.steps)) for t in (tensors, decoded))
        error = np.abs(rule.turn(before) - rule.turn(after))
        assert (error <= 0.5 * rule.steps + 1e-5).all() and error.max() > 0.3 * rule.steps.max()
    for name in ("changing_anchors", "used_offsets"):
        np.testing.assert_array_equal(decoded[name], tensors[name])
    np.testing.assert_allclose(decoded["anchors"], tensors["anchors"], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(decoded["head.w1"], tensors["head.w1"].astype(np.float16))
    assert {n: (t.shape, t.dtype) for n, t in decoded.items()} == {
        n: (t.shape, t.dtype) for n, t in tensors.items()
    }


def test_coding_is_shorter_than_the_plain_form_and_the_entropy_is_reached():
    assert len(coded()) < 0.5 * len(plain())
    values = np.random.default_rng(1).integers(0, 6, 20_000).astype(np.int32) ** 2
    bits = 8 * len(encode({"values": values}, {}, {}))
    assert bits < 20_000 * np.log2(6) * 1.01 + 8 * 300


def test_turning_finds_what_columns_have_in_common():
    rng = np.random.default_rng(2)
    rows = (rng.standard_normal((500, 1)) @ rng.standard_normal((1, 9))).astype(np.float32)
    turned = Columns.of(rows).turn(rows).std(axis=0)
    assert np.sum(turned > 0.01 * turned.max()) == 1


def test_equal_models_give_equal_files():
    assert coded() == encode(*model())


def test_positions_on_no_grid_may_coincide():
    pytest.importorskip("constriction", reason="coded models need constriction")
    rng = np.random.default_rng(3)
    means = rng.standard_normal((300, 3)).astype(np.float32)
    means[50:60] = means[50]
    grid = Grid.of(means, None)
    means = means[np.argsort(morton(grid.codes(means)))]
    decoded = decode(encode({"means": means}, {"means": grid}, {}))["means"]
    np.testing.assert_allclose(decoded, means, rtol=0, atol=0.51 * grid.step + 1e-6)


def test_one_position_and_a_column_of_equal_numbers():
    tensors = {"means": np.full((1, 3), 2.5, np.float32), "same": np.ones((1, 2), np.float32)}
    grids = {"means": Grid.of(tensors["means"], None)}
    decoded = decode(encode(tensors, grids, {"same": Columns.of(tensors["same"])}))
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(decoded[name], tensor)


def test_without_the_package_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "constriction", None)
    with pytest.raises(ConfigError, match=r"constriction.*pip install 'chronoscene\[compress\]'"):
        encode(*model())


def signed(rest, *, size, packed):
    """A file whose head agrees with what follows."""
    return HEAD.pack(MAGIC, VERSION, zlib.crc32(rest), size, packed) + rest


@pytest.mark.parametrize("signs", [False, True])
@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_a_damaged_file_ends_in_one_error(signs, data):
    """Also where somebody has made the checksum agree with the damage."""
    whole = data.draw(st.sampled_from([coded(), plain()]))
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    if len(damaged) == len(whole) or signs:
        for _ in range(data.draw(st.integers(1, 3))):
            at = data.draw(st.integers(0, max(0, len(damaged) - 1)))
            damaged[at : at + 1] = bytes([data.draw(st.integers(0, 255))])
    if bytes(damaged) == whole:
        return
    if signs and len(damaged) > HEAD.size:
        damaged[12:16] = zlib.crc32(damaged[HEAD.size :]).to_bytes(4, "little")
    try:
        decoded = decode(bytes(damaged), "the place")
    except CheckpointError as error:
        assert "the place" in str(error)
    else:  # other symbols of the same frequencies cannot be told from the right ones
        assert signs and len(decoded) == 7


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data())
def test_hostile_tables_end_in_one_error(data):
    """Damage inside of the first block, which is packed again as if it were right."""
    whole = coded()
    *_, packed = HEAD.unpack(whole[: HEAD.size])
    raw = bytearray(lzma.decompress(whole[HEAD.size : HEAD.size + packed]))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(raw) - 1) | st.integers(0, 900))
        raw[at : at + 1] = data.draw(st.binary(min_size=0, max_size=4))
    again = lzma.compress(bytes(raw), preset=0)
    rest = again + whole[HEAD.size + packed :]
    with np.errstate(all="ignore"), suppress(CheckpointError):
        decode(signed(rest, size=len(raw), packed=len(again)))


@pytest.mark.parametrize(
    "listed",
    [
        b'[{"name": "a", "type": "float32", "shape": [1000000000000], "coding": "half"}]',
        b'[{"name": "a", "type": "float32", "shape": [1000000000000, 0], "coding": "as is"}]',
        b'[{"name": "a", "type": "int32", "shape": [3], "coding": "half"}]',
        b'[{"name": "a", "type": "float32", "shape": [-1], "coding": "half"}]',
        b'[{"name": "a", "type": "object", "shape": [1], "coding": "as is"}]',
        b'[{"name": "a", "type": "float32", "shape": [0, 3], "coding": "columns"}]',
        b"[]",
        b"[",
    ],
)
def test_hostile_lists_of_tensors_are_refused(listed):
    raw = len(listed).to_bytes(4, "little") + listed + bytes(40)
    packed = lzma.compress(raw)
    with pytest.raises(CheckpointError):
        decode(signed(packed, size=len(raw), packed=len(packed)))


def test_a_block_that_unpacks_to_more_than_it_says_is_refused():
    packed = lzma.compress(bytes(10**8))
    for size in (100, 2**32 - 1):
        with pytest.raises(CheckpointError):
            decode(signed(packed, size=size, packed=len(packed)))

"""Files of Gaussians, as readers that share no code with the writers give them back."""

import gzip
import io
import json
import struct
import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from benchmarks.exports import readers
from chronoscene.errors import ConfigError
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.splat_files import SUFFIXES, decode, encode, gltf, sog, spz, with_comments

UP = (0.0, 0.0, 1.0)


def make_cloud(count=40, seed=0, spread=50.0):
    rng = np.random.default_rng(seed)
    return GaussianCloud(
        means=rng.normal(0, spread, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        scales=np.exp(rng.normal(-3, 1, (count, 3))).astype(np.float32),
        opacities=rng.uniform(0.02, 0.98, count).astype(np.float32),
        sh_coeffs=rng.normal(0, 0.2, (count, 16, 3)).astype(np.float32),
    )


def rotation(quats):
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T.astype(np.float64)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def shapes(cloud):
    """Covariances in units of the largest variance: the same for all quaternions of a shape."""
    half = rotation(cloud.quats) * cloud.scales[:, None]
    covariances = half @ half.swapaxes(1, 2)
    return covariances / (cloud.scales.max(axis=1) ** 2)[:, None, None]


def in_order_of(cloud, other):
    """The Gaussians in the order in which another cloud has the same centres."""
    distances = ((other.means[:, None] - cloud.means[None]) ** 2).sum(-1)
    order = distances.argmin(axis=1)
    assert len(set(order.tolist())) == len(cloud)
    return GaussianCloud(*(getattr(cloud, field.name)[order] for field in fields(cloud)))


def write(path, kind, cloud, comments=()):
    file = path / f"a{SUFFIXES[kind]}"
    data = encode(kind, cloud, antialiased=False, up=UP)
    file.write_bytes(with_comments(kind, data, comments) if comments else data)
    return file


STEPS = {
    # centre, logarithm of the scale, shape, opacity, constant coefficient, others
    "ply": (0, 1e-5, 1e-5, 1e-6, 0, 0),
    "gltf": (0, 0, 1e-5, 0, 0, 0),
    "splat": (0, 0, 0.05, 0.0021, 0.008, None),
    # Steps of 1/4096; 1/16; 9 bits; 1/255; 1/38.25; 1/16 with a limit at 1.
    "spz": (2**-12, 0.0313, 0.015, 0.002, 0.0131, 0.067),
    # 1/65536 of the range of logarithms, which is at most 15, and float32.
    # A table of 256 values and a palette of a fifth of the Gaussians: only near on the average.
    "sog": (1.2e-4, 0.06, 0.03, 0.002, 0.02, None),
}


@pytest.mark.parametrize("kind", STEPS)
@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 1000), spread=st.sampled_from([0.5, 20.0, 400.0]))
def test_another_reader_finds_the_gaussians(tmp_path_factory, kind, seed, spread):
    if kind == "gltf":
        pytest.importorskip("pygltflib")
    cloud = make_cloud(seed=seed, spread=spread)
    file = write(tmp_path_factory.mktemp("file"), kind, cloud)
    read = readers.read(file)
    cloud = in_order_of(cloud, read) if kind == "splat" else cloud
    centre, scale, shape, opacity, dc, rest = STEPS[kind]
    size = 1 + np.abs(cloud.means) if kind == "sog" else 1  # SOG has a logarithmic scale
    assert (np.abs(read.means - cloud.means) / size).max() <= centre
    assert np.abs(np.log(read.scales / cloud.scales)).max() <= scale + 1e-6
    assert np.abs(shapes(read) - shapes(replace(cloud, scales=read.scales))).max() <= shape
    assert np.abs(read.opacities - cloud.opacities).max() <= opacity
    assert np.abs(read.sh_coeffs[:, 0] - cloud.sh_coeffs[:, 0]).max() <= dc
    if rest is not None:
        assert np.abs(read.sh_coeffs[:, 1:] - cloud.sh_coeffs[:, 1:].clip(-1, 1)).max() <= rest
    # The own reader, by which losses are measured, gives the same numbers.
    own = decode(kind, file.read_bytes())
    for name in ("means", "scales", "opacities", "sh_coeffs"):
        np.testing.assert_allclose(getattr(own, name), getattr(read, name), rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(shapes(own), shapes(read), atol=1e-5)


def test_gaussians_of_the_same_harmonics_keep_them_in_a_palette(tmp_path):
    cloud = make_cloud(50)
    cloud.sh_coeffs[:, 1:] = np.repeat(cloud.sh_coeffs[:10, 1:], 5, axis=0)
    read = readers.read(write(tmp_path, "sog", cloud))
    error = read.sh_coeffs[:, 1:] - cloud.sh_coeffs[:, 1:]
    assert np.abs(error).mean() < 0.02 * np.abs(cloud.sh_coeffs[:, 1:]).mean() + 0.05


@pytest.mark.parametrize("kind", SUFFIXES)
def test_equal_gaussians_give_equal_bytes(kind):
    a, b = (encode(kind, make_cloud(), antialiased=True, up=UP) for _ in "ab")
    assert a == b


def test_comments_are_where_the_format_has_a_place(tmp_path):
    comments = ("first line", "second: 21.50 dB")
    ply = write(tmp_path, "ply", make_cloud(), comments)
    assert PlyData.read(ply).comments == list(comments)
    glb = write(tmp_path, "gltf", make_cloud(), comments).read_bytes()
    document = json.loads(glb[20 : 20 + struct.unpack_from("<I", glb, 12)[0]])
    assert document["asset"]["extras"]["comments"] == list(comments)
    sog_file = write(tmp_path, "sog", make_cloud(), comments)
    meta = json.loads(zipfile.ZipFile(sog_file).read("meta.json"))
    assert meta["asset"]["comments"] == list(comments)


@pytest.mark.parametrize("antialiased", [False, True])
def test_an_spz_file_says_whether_to_use_the_filter(antialiased):
    header = gzip.decompress(spz.encode(make_cloud(), antialiased=antialiased))[:16]
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", header)
    assert (magic, version, count, degree, reserved) == (0x5053474E, 3, 40, 3, 0)
    assert flags == int(antialiased) and bits == 12


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_sog_file_says_whether_to_use_the_filter(antialiased):
    data = encode("sog", make_cloud(), antialiased=antialiased, up=UP)
    meta = json.loads(zipfile.ZipFile(io.BytesIO(data)).read("meta.json"))
    assert meta["antialias"] is antialiased


@pytest.mark.parametrize(("spread", "step"), [(1e-2, 1.1e-6), (100.0, 2**-12), (20_000.0, 2**-5)])
def test_the_resolution_of_spz_follows_the_size_of_the_scene(spread, step):
    cloud = make_cloud(spread=spread)
    read = spz.decode(spz.encode(cloud, antialiased=False))
    assert np.abs(read.means - cloud.means).max() <= step


def test_a_gaussian_far_away_does_not_coarsen_the_others_in_spz(tmp_path):
    """The description of the format: 24 bits with a sign, in steps of 2^-bits."""
    cloud = make_cloud(2_000)
    cloud.means[7] = 3e6, -5, 7
    assert spz.count_far(cloud) == 1
    read = readers.read(write(tmp_path, "spz", cloud))
    error = np.abs(read.means - cloud.means)
    assert error[7, 1:].max() <= 2**-10 and read.means[7, 0] >= 64 * 100
    assert np.delete(error, 7, axis=0).max() <= 2**-10
    sky = replace(cloud, means=np.where(cloud.means > 1e6, 2_000, cloud.means).astype(np.float32))
    assert spz.count_far(sky) == 0
    assert np.abs(readers.read(write(tmp_path, "spz", sky)).means - sky.means).max() <= 2**-13


def test_gltf_that_its_header_cannot_count_is_refused(monkeypatch):
    cloud = make_cloud(10)
    monkeypatch.setattr(gltf, "MAX_BYTES", gltf._REST + 2_400)
    assert len(gltf.encode(cloud, up=UP)) < gltf.MAX_BYTES
    monkeypatch.setattr(gltf, "MAX_BYTES", gltf._REST + 2_399)
    with pytest.raises(ConfigError, match="at most 9 Gaussians, as the file ends at 4 GiB, found"):
        gltf.encode(cloud, up=UP)


def test_a_node_of_gltf_turns_up_to_y(tmp_path):
    for up in ((0, 0, 1), (0, -1, 0), (0, 1, 0), (0.6, 0.0, -0.8)):
        data = encode("gltf", make_cloud(2), antialiased=False, up=up)
        document = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
        x, y, z, w = document["nodes"][0]["rotation"]
        turned = rotation(np.array([[w, x, y, z]]))[0] @ np.array(up)
        np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-6)
        assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
        assert len(data) == struct.unpack_from("<I", data, 8)[0] and len(data) % 4 == 0


def test_colours_of_transparent_gaussians_survive_webp():
    cloud = make_cloud()
    cloud.opacities[:] = 0
    read = sog.decode(sog.encode(cloud, antialiased=False))
    assert np.abs(read.sh_coeffs[:, 0] - cloud.sh_coeffs[:, 0]).max() < 0.02


def test_images_of_sog_that_are_opaque_throughout_are_read():
    cloud = make_cloud(16)  # fill 4 x 4 pixels
    cloud.opacities[:] = 1
    cloud.quats[:] = 0, 0, 0, 1  # 255 says that z is left out
    read = sog.decode(sog.encode(cloud, antialiased=False))
    assert (read.opacities == 1).all()
    np.testing.assert_allclose(shapes(read), shapes(cloud), atol=0.03)


@pytest.mark.parametrize("kind", SUFFIXES)
def test_one_gaussian_alone_makes_a_file(kind):
    cloud = make_cloud(1)
    read = decode(kind, encode(kind, cloud, antialiased=False, up=UP))
    np.testing.assert_allclose(read.means, cloud.means, atol=2e-3)


def test_centres_beyond_the_range_of_spz_become_its_limits():
    far = replace(make_cloud(), means=np.full((40, 3), 1e8, np.float32))
    made = decode("spz", encode("spz", far, antialiased=False, up=UP))
    assert (made.means == 2**23 - 1).all()

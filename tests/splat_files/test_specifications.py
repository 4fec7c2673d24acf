"""Files of Gaussians against the written specifications of their formats, by hand.

glTF 2.0 (chapter 4.4 for GLB, 3.6 for buffers and accessors) with KHR_gaussian_splatting, and SOG,
version 2, of PlayCanvas. Nothing here knows how the files are written or read elsewhere.
"""

import io
import json
import struct
import zipfile

import numpy as np
import pytest
from PIL import Image

from chronoscene.splat_files import encode, with_comments

from .test_formats import UP, make_cloud

PREFIX = "KHR_gaussian_splatting"
COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
ATTRIBUTES = {"POSITION": "VEC3"}
ATTRIBUTES |= {f"{PREFIX}:ROTATION": "VEC4", f"{PREFIX}:SCALE": "VEC3"}
ATTRIBUTES |= {f"{PREFIX}:OPACITY": "SCALAR"}
ATTRIBUTES |= {
    f"{PREFIX}:SH_DEGREE_{d}_COEF_{n}": "VEC3" for d in range(4) for n in range(2 * d + 1)
}
"""Attributes of degree 3 with their types."""


def file_of(kind, count, comment):
    return with_comments(kind, encode(kind, make_cloud(count), antialiased=False, up=UP), [comment])


def glb_parts(data):
    """The document and the binary chunk; checks the container."""
    magic, version, total = struct.unpack_from("<4sII", data)
    assert (magic, version, total) == (b"glTF", 2, len(data)) and total % 4 == 0
    chunks, at = [], 12
    while at < total:
        length, kind = struct.unpack_from("<I4s", data, at)
        assert length % 4 == 0 and at + 8 + length <= total
        chunks.append((kind, data[at + 8 : at + 8 + length]))
        at += 8 + length
    assert [kind for kind, _ in chunks] == [b"JSON", b"BIN\0"]
    text = chunks[0][1].decode("utf-8")
    assert text.startswith("{") and len(text) - len(text.rstrip(" ")) < 4  # filled up with blanks
    return json.loads(text, parse_constant=pytest.fail), chunks[1][1]


@pytest.mark.parametrize(("count", "comment"), [(1, ""), (40, "a"), (41, "äb"), (7, "abc")])
def test_gltf(count, comment):
    document, binary = glb_parts(file_of("gltf", count, comment))
    assert document["asset"]["version"] == "2.0" and document["asset"]["extras"]
    assert document["extensionsUsed"] == [PREFIX] and "extensionsRequired" not in document
    (buffer,) = document["buffers"]
    assert "uri" not in buffer and 0 <= len(binary) - buffer["byteLength"] < 4
    assert not any(binary[buffer["byteLength"] :])
    (mesh,), (node,) = document["meshes"], document["nodes"]
    assert document["scenes"][document["scene"]]["nodes"] == [0] and node["mesh"] == 0
    assert np.linalg.norm(node["rotation"]) == pytest.approx(1, abs=1e-6)
    (primitive,) = mesh["primitives"]
    assert primitive["mode"] == 0 and "indices" not in primitive
    assert primitive["extensions"] == {
        PREFIX: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    }
    assert primitive["attributes"].keys() == ATTRIBUTES.keys()

    columns = {}
    for name, number in primitive["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        assert (accessor["type"], accessor["componentType"]) == (ATTRIBUTES[name], 5126)
        assert accessor["count"] == count and "normalized" not in accessor
        width = COMPONENTS[accessor["type"]]
        start, size = view["byteOffset"] + accessor.get("byteOffset", 0), 4 * width * count
        assert view["buffer"] == 0 and view["target"] == 34962 and "byteStride" not in view
        assert start % 4 == 0 and size <= view["byteLength"]
        assert view["byteOffset"] + view["byteLength"] <= buffer["byteLength"]
        values = struct.unpack_from(f"<{width * count}f", binary, start)
        columns[name] = np.reshape(values, (count, width))
        assert np.isfinite(columns[name]).all()
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == columns["POSITION"].min(axis=0).tolist()
    assert position["max"] == columns["POSITION"].max(axis=0).tolist()
    lengths = np.linalg.norm(columns[f"{PREFIX}:ROTATION"], axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-6)
    assert (columns[f"{PREFIX}:SCALE"] >= 0).all()
    opacities = columns[f"{PREFIX}:OPACITY"]
    assert (opacities >= 0).all() and (opacities <= 1).all()


@pytest.mark.parametrize("count", [1, 40, 700])
def test_sog(count):
    """700 Gaussians have more than two lines of the palette."""
    with zipfile.ZipFile(io.BytesIO(file_of("sog", count, "a"))) as archive:
        assert archive.testzip() is None and not any("/" in name for name in archive.namelist())
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files.pop("meta.json"), parse_constant=pytest.fail)
    assert (meta["version"], meta["count"]) == (2, count)
    named = {part: meta[part]["files"] for part in ("means", "scales", "quats", "sh0", "shN")}
    assert sorted(name for names in named.values() for name in names) == sorted(files)
    assert [len(names) for names in named.values()] == [2, 1, 1, 1, 2]
    images = {}
    for name, data in files.items():
        assert (data[:4], data[8:12]) == (b"RIFF", b"WEBP") and b"VP8L" in data[12:64]  # lossless
        images[name] = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))
    centroids, labels = named["shN"]
    sizes = {image.shape[:2] for name, image in images.items() if name != centroids}
    ((height, width),) = sizes
    assert width * height >= count

    def pixels(name):
        return images[name].reshape(-1, 4)[:count].astype(int)

    for part in ("scales", "sh0", "shN"):
        assert len(meta[part]["codebook"]) == 256 and np.isfinite(meta[part]["codebook"]).all()
    assert [len(meta["means"][end]) for end in ("mins", "maxs")] == [3, 3]
    assert set(pixels(named["quats"][0])[:, 3]) <= {252, 253, 254, 255}
    palette = meta["shN"]["count"]
    assert meta["shN"]["bands"] == 3 and 1 <= palette <= 65536
    assert images[centroids].shape[:2] == (-(-palette // 64), 64 * 15)
    assert (pixels(labels)[:, 0] + 256 * pixels(labels)[:, 1]).max() < palette

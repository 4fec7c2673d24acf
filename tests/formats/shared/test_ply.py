"""Point clouds in PLY files."""

import dataclasses

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from chronoscene.errors import SceneError
from chronoscene.formats.shared.ply import read_points, write_points, write_vertices
from chronoscene.scene import Points

HEAD = "ply\nformat {form} 1.0\ncomment x\nelement vertex {count}\n{properties}end_header\n"
XYZ = "".join(f"property float {c}\n" for c in "xyz")
RGB = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))


def put(path, body, *, form="ascii", count=1, properties=XYZ + RGB):
    head = HEAD.format(form=form, count=count, properties=properties).encode()
    path.write_bytes(head + (body.encode() if isinstance(body, str) else body))
    return path


@given(
    arrays.arrays(
        np.float64, (st.integers(0, 9)).map(lambda n: (n, 3)), elements=st.floats(-1e9, 1e9)
    )
)
def test_round_trip(tmp_path_factory, xyz):
    n = len(xyz)
    rgb = np.arange(3 * n, dtype=np.uint8).reshape(n, 3)
    points = dataclasses.replace(Points.empty(), xyz=xyz, rgb=rgb, ids=np.arange(1, n + 1))
    path = tmp_path_factory.mktemp("ply") / "p.ply"
    write_points(path, points)
    again = read_points(path)
    np.testing.assert_array_equal(again.xyz, xyz)
    np.testing.assert_array_equal(again.rgb, rgb)
    assert again.ids.tolist() == list(range(1, n + 1))
    assert again.track_start.tolist() == [0] * (n + 1)


def test_text(tmp_path):
    points = read_points(put(tmp_path / "p.ply", "1 2 3 4 5 6\n-1e2 .5 0 255 0 7", count=2))
    assert points.xyz.tolist() == [[1, 2, 3], [-100, 0.5, 0]]
    assert points.rgb.tolist() == [[4, 5, 6], [255, 0, 7]]


@pytest.mark.parametrize(("form", "order"), [("little", "<"), ("big", ">")])
def test_byte_orders_and_other_properties(tmp_path, form, order):
    record = np.dtype(
        [("nx", f"{order}f8"), ("z", f"{order}f4"), ("y", f"{order}f4"), ("x", f"{order}i2")]
    )
    data = np.array([(9.0, 3.5, 2.5, 1)], record)
    properties = "property double nx\nproperty float z\nproperty float32 y\nproperty short x\n"
    path = put(
        tmp_path / "p.ply", data.tobytes(), form=f"binary_{form}_endian", properties=properties
    )
    points = read_points(path)
    assert points.xyz.tolist() == [[1, 2.5, 3.5]]
    assert points.rgb.tolist() == [[128, 128, 128]]


def test_agrees_with_another_reader(tmp_path):
    xyz = np.random.default_rng(0).normal(size=(20, 3))
    rgb = np.arange(60, dtype=np.uint8).reshape(20, 3)
    points = dataclasses.replace(Points.empty(), xyz=xyz, rgb=rgb, ids=np.arange(20))
    write_points(tmp_path / "p.ply", points)
    vertex = plyfile.PlyData.read(tmp_path / "p.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[c] for c in "xyz"], 1), xyz)
    np.testing.assert_array_equal(np.stack([vertex[c] for c in ("red", "green", "blue")], 1), rgb)


def test_further_columns(tmp_path):
    xyz, rgb = np.arange(6.0).reshape(2, 3), np.arange(6, dtype=np.uint8).reshape(2, 3)
    score = np.array([0.5, 2], np.float32)
    write_vertices(tmp_path / "p.ply", xyz, rgb, score=score, period=np.array([0, 7], np.int32))
    vertex = plyfile.PlyData.read(tmp_path / "p.ply")["vertex"]
    assert vertex["score"].tolist() == [0.5, 2]
    assert vertex["period"].tolist() == [0, 7]
    again = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(again.xyz, xyz)
    np.testing.assert_array_equal(again.rgb, rgb)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"body": "1 2 3 4 5 6", "count": 2}, "expected 2 vertices, found 11 bytes"),
        ({"body": b"", "form": "binary_little_endian", "count": 10**15}, "vertices, found 0 bytes"),
        ({"body": b"x" * 14, "form": "binary_little_endian"}, "1 vertices, found 14 bytes"),
        ({"body": "1 2 nan 4 5 6"}, "finite positions"),
        ({"body": "1 2 3 4 5 256"}, "whole numbers of type uint8 as blue"),
        ({"body": "1 2 3 4 nan 6"}, "whole numbers of type uint8 as green"),
        ({"body": " " * 20 + "\n" * 20}, "1 vertices, found 0 lines|6 numbers for each"),
        ({"body": "1 2 x 4 5 6"}, "6 numbers for each vertex"),
        ({"body": "1 2 3 4 5\n..."}, "6 numbers for each vertex"),
        (
            {"body": "", "form": "zip"},
            "a header of PLY, found line 2: don't understand format 'zip'",
        ),
        ({"body": "", "properties": "property float x\n"}, "vertices with x, y and z"),
        (
            {"body": "", "properties": XYZ + XYZ},
            "a header of PLY, found two properties with same name",
        ),
        ({"body": "", "properties": "property list uchar int i\n"}, "numbers as properties"),
        ({"body": "1 2 3 1 1 1", "properties": XYZ + RGB.replace("uchar", "float")}, "type uchar"),
    ],
)
def test_files_that_are_refused(tmp_path, options, message):
    with pytest.raises(SceneError, match=message):
        read_points(put(tmp_path / "p.ply", options.pop("body"), **options))


@pytest.mark.parametrize("count", ["-1", "+9999999999", "9_999_999_999", "9" * 5000, "", "1 1"])
@pytest.mark.parametrize("element", ["vertex", "face"])
def test_counts_that_are_refused(tmp_path, element, count):
    text = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex 0\n{XYZ}element {element} {count}\n"
    )
    (tmp_path / "p.ply").write_text(f"{text}end_header\n")
    with pytest.raises(SceneError, match="expected elements with a name and a number"):
        read_points(tmp_path / "p.ply")


def test_what_follows_the_vertices_is_not_read(tmp_path):
    faces = "element face 99999999999\nproperty list uchar int i\n"
    path = put(tmp_path / "p.ply", "1 2 3 4 5 6\n3 0", properties=XYZ + RGB + faces)
    assert read_points(path).xyz.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("text", ["", "plyx\n", "ply\n", "ply\nformat ascii 1.0\nend_header\n"])
def test_headers_that_are_refused(tmp_path, text):
    (tmp_path / "p.ply").write_text(text)
    with pytest.raises(SceneError, match=r"expected (a PLY file|a header|vertices)"):
        read_points(tmp_path / "p.ply")


def test_faces_before_vertices_are_refused(tmp_path):
    text = "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 1\n"
    (tmp_path / "p.ply").write_text(f"{text}{XYZ}end_header\n3 0 0 0\n1 2 3\n")
    with pytest.raises(SceneError, match="vertices as the first element, found 'face'"):
        read_points(tmp_path / "p.ply")


def test_a_missing_file(tmp_path):
    with pytest.raises(SceneError, match=r"p\.ply: expected a PLY file, found No such file"):
        read_points(tmp_path / "p.ply")

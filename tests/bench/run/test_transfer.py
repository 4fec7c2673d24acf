"""Files arrive as they were sent, or the error says so."""

import pytest

from chronoscene.bench.run import transfer
from chronoscene.bench.run.transfer import (
    check_arrived,
    content_hash,
    find_copy,
    keep_copy,
    read_pieces,
    write_piece,
)
from chronoscene.errors import CheckpointError


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Files of several pieces and of none, one of them behind a link."""
    monkeypatch.setattr(transfer, "PIECE", 4)
    root = tmp_path / "here" / "scene"
    (root / "sparse/0").mkdir(parents=True)
    (root / "sparse/0/points3D.bin").write_bytes(bytes(range(9)))
    (root / "empty.txt").touch()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/früh 1.png").write_bytes(b"1234")
    (root / "images").symlink_to(tmp_path / "photos")
    return root


def test_a_folder_travels_in_pieces(folder, tmp_path):
    pieces, digest = list(read_pieces(folder)), content_hash(folder)
    assert [name for name, _ in pieces] == [
        "empty.txt", "images/früh 1.png", *["sparse/0/points3D.bin"] * 3
    ]  # fmt: skip
    copies = tmp_path / "copies"
    assert find_copy(folder, digest, copies) == folder
    away = tmp_path / "there" / "scene"
    assert find_copy(away, digest, copies) is None
    for number in range(2):  # the second one finds that there is one already
        arrived = copies / f".arriving{number}"
        for piece in pieces:
            write_piece(arrived, *piece)
        copy = keep_copy(arrived, digest, copies, "scene")
        assert copy.name == "scene" and find_copy(away, digest, copies) == copy
    assert content_hash(copy) == digest
    (folder / "empty.txt").write_text("changed")
    assert find_copy(folder, digest, tmp_path / "others") is None


def test_a_file_travels_too(folder, tmp_path):
    file = folder / "sparse/0/points3D.bin"
    for piece in read_pieces(file):
        write_piece(tmp_path / "copy.bin", *piece)
    assert (tmp_path / "copy.bin").read_bytes() == file.read_bytes()
    check_arrived(tmp_path / "copy.bin", content_hash(file))


def test_what_is_not_what_was_sent_is_refused(folder, tmp_path):
    digest = content_hash(folder)
    write_piece(tmp_path / "arrived", "empty.txt", b"x")
    with pytest.raises(CheckpointError, match="expected the files that were sent, found others"):
        keep_copy(tmp_path / "arrived", digest, tmp_path, "scene")
    with pytest.raises(CheckpointError, match="found a path that leads outside"):
        write_piece(tmp_path / "arrived", "../x", b"x")

"""Text and JSON that is not trusted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.errors import CheckpointError, SceneError
from chronoscene.io.documents import decode_text, read_json_document

texts = st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1, max_size=12)


@given(texts, st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]))
def test_encodings(text, encoding):
    assert decode_text(text.lstrip("\ufeff").encode(encoding)) == text.lstrip("\ufeff")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1, "a": 2}', "expected JSON, found the key 'a' twice in an object; copy it"),
        (b"[1]", "expected an object, found list; copy it"),
        (b"{", "expected JSON, found Expecting property name"),
        (b"[" * 100_000, "expected JSON, found lists or objects nested too deeply; copy it"),
        (b'{"a": "\\ud800"}', "expected JSON, found 'utf-8' codec can't encode"),
        (b"\xff", "expected a text file, found bytes that are not UTF-8; save it as UTF-8"),
    ],
)
def test_damaged_documents_are_refused(tmp_path, content, message):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(CheckpointError) as error:
        read_json_document(tmp_path / "a.json", error=CheckpointError, todo="copy it")
    assert message in str(error.value)


def test_a_missing_document_is_refused(tmp_path):
    with pytest.raises(SceneError, match="expected a text file, found nothing; check the path"):
        read_json_document(tmp_path / "a.json", list)

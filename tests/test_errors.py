"""Messages have one form, and checks name what is known."""

import pickle

import numpy as np
import pytest

from chronoscene.checks import check_choice, check_shape
from chronoscene.errors import MAX_LENGTH, ChronoSceneError, ConfigError, SceneError, ShapeError


def test_message_has_place_expectation_finding_and_remedy():
    error = ChronoSceneError("a.txt:3", expected="two fields", found="one", todo="see DATASET.md")
    assert str(error) == "a.txt:3: expected two fields, found one; see DATASET.md"


def test_errors_travel_between_processes():
    error = SceneError("a.txt:3", expected="two fields", found="one", todo="see DATASET.md")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is SceneError
    assert again.fields == error.fields and str(again) == str(error)


def test_long_quotations_are_shortened():
    error = ChronoSceneError(
        "a.txt", expected="x" * 10**6, found="<" + "9" * 10**6 + ">", todo="no"
    )
    assert len(str(error)) < 2 * MAX_LENGTH + 100
    assert error.found.startswith("<9") and error.found.endswith("9>")


def test_check_shape_accepts_wildcards_and_refuses_the_rest():
    check_shape("means", np.zeros((5, 3)), [None, 3])
    with pytest.raises(ShapeError, match=r"means: expected shape \[\*, 3\], found \[5, 4\]"):
        check_shape("means", np.zeros((5, 4)), [None, 3])
    with pytest.raises(ShapeError):
        check_shape("means", np.zeros(3), [None, 3])


def test_check_choice_suggests_the_nearest():
    assert check_choice("--preset", "fast", ["fast", "paper"]) == "fast"
    with pytest.raises(ConfigError, match="one of fast, paper, found 'papr'; did you mean 'paper'"):
        check_choice("--preset", "papr", ["fast", "paper"])
    with pytest.raises(SceneError):
        check_choice("x", "y", ["z"], error=SceneError)

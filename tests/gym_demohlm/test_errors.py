"""Errors: the sentence, suggestions, and the way between processes."""

import pickle

import pytest

from gym_demohlm import errors


@pytest.mark.parametrize(
    "error",
    [
        errors.CommandError("NaN", "numbers", "check"),
        errors.UnknownNameError("task", "LiftBoks", ["LiftBox", "PushCart"]),
    ],
)
def test_errors_survive_pickling(error: errors.DemoHLMError) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert (copy.got, copy.expected, copy.remedy) == (error.got, error.expected, error.remedy)


def test_unknown_name_suggests_the_closest() -> None:
    assert "did you mean 'LiftBox'?" in str(errors.UnknownNameError("task", "LiftBoks", ["LiftBox", "PushCart"]))
    assert "choose one of these" in str(errors.UnknownNameError("task", "zzz", ["LiftBox"]))

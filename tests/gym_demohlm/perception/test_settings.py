"""Texts of perceptions: there and back, and what is refused."""

import pytest

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.perception.settings import PerceptionSettings


def test_a_text_is_read_and_written_back() -> None:
    text = "rgbd,masks=color,camera_error=1,mesh_scale=1.02,dropout=0.25"
    settings = PerceptionSettings.read(text)
    assert settings.masks == "color" and settings.mesh_scale == 1.02 and str(settings) == text
    assert PerceptionSettings.read(settings) is settings
    assert str(PerceptionSettings.read("exact,bias_mm=0")) == "exact"


def test_only_the_plain_one_is_exact() -> None:
    assert PerceptionSettings().is_exact and not PerceptionSettings().is_disturbed
    biased = PerceptionSettings(bias_mm=5.0)
    assert biased.is_disturbed and not biased.is_exact


@pytest.mark.parametrize(
    "text",
    [
        "exact,masks=color",
        "model,camera_error=1",
        "exact,mesh_scale=1.02",
        "rgbd,dropout=-1",
        "rgbd,dropout=x",
        "rgbd,mesh_scale=9",
    ],
)
def test_what_does_not_fit_is_an_error(text: str) -> None:
    with pytest.raises(SceneError):
        PerceptionSettings.read(text)


@pytest.mark.parametrize(
    ("text", "near"), [("rgdb", "rgbd"), ("rgbd,mask=color", "masks"), ("rgbd,masks=colour", "color")]
)
def test_an_unknown_name_is_an_error_that_names_the_nearest(text: str, near: str) -> None:
    with pytest.raises(UnknownNameError, match=f"did you mean '{near}'"):
        PerceptionSettings.read(text)

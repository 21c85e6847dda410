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
        "remote,mesh_scale=1.02",
        "exact,fit=errors.json",
        "apriltag,fit=errors.json",
        "rgbd,timeout_s=3",
        "rgbd,address=tcp://127.0.0.1:5571",
        "rgbd,masks=server",
    ],
)
def test_what_does_not_fit_is_an_error(text: str) -> None:
    with pytest.raises(SceneError):
        PerceptionSettings.read(text)


@pytest.mark.parametrize(
    "text",
    [
        "exact,bias_mm=5,latency_s=0.1,dropout=0.5",
        "model,bias_mm=5,fit=errors.json",
        "apriltag,camera_error=1,mesh_scale=1.02,latency_s=0.2",
        "remote,masks=server,camera_error=1,dropout=0.5,address=tcp://127.0.0.1:5571,timeout_s=3",
    ],
)
def test_options_that_a_source_has_are_kept(text: str) -> None:
    assert str(PerceptionSettings.read(text)) == text


def test_an_option_of_another_source_is_an_error_that_names_its_sources() -> None:
    with pytest.raises(
        SceneError, match=r"mesh_scale=1\.02 with perception 'remote'; expected it with rgbd or apriltag"
    ):
        PerceptionSettings.read("remote,mesh_scale=1.02")


@pytest.mark.parametrize(
    ("text", "near"), [("rgdb", "rgbd"), ("rgbd,mask=color", "masks"), ("rgbd,masks=colour", "color")]
)
def test_an_unknown_name_is_an_error_that_names_the_nearest(text: str, near: str) -> None:
    with pytest.raises(UnknownNameError, match=f"did you mean '{near}'"):
        PerceptionSettings.read(text)

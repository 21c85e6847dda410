"""Names of variations, ranges, draws, and conditions in initial states."""

from pathlib import Path

import pytest

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.variation import NONE, Conditions, Variation, get_variation
from gym_demohlm.variation.factors import FACTORS, GROUPS
from gym_demohlm.variation.table import filled
from tests.helpers.paths import REPOSITORY


def test_names() -> None:
    assert get_variation("none") is NONE and not NONE
    assert get_variation("real").groups == GROUPS
    assert get_variation("real:pushes+objects").groups == ("objects", "pushes")
    for name in ("hard@0", "real@0.0:pushes+objects", "none@2", "none:objects"):
        assert get_variation(name) is NONE


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("reel", UnknownNameError, "did you mean 'real'"),
        ("real:object", UnknownNameError, "did you mean 'objects'"),
        ("real@much", SceneError, "from 0 to 3"),
        ("real@9", SceneError, "from 0 to 3"),
    ],
)
def test_bad_names_are_explained(name: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        get_variation(name)


def test_impossible_ranges_are_refused() -> None:
    with pytest.raises(SceneError, match=r"objects\.size from 0\.5 to 9"):
        Variation(name="mine", ranges={"objects.size": (0.5, 9.0)})
    with pytest.raises(SceneError, match="lower end first"):
        Variation(name="mine", ranges={"objects.mass": (2.0, 1.0)})
    with pytest.raises(UnknownNameError, match=r"objects\.mass"):
        Variation(name="mine", ranges={"objects.mas": (1.0, 2.0)})


def test_strength_moves_ranges_towards_the_plain_world() -> None:
    half, whole = get_variation("hard@0.5"), get_variation("hard")
    for key, factor in FACTORS.items():
        for now, then in zip(half.ranges[key], whole.ranges[key], strict=True):
            if factor.neutral is not None:
                assert now - factor.neutral == pytest.approx(0.5 * (then - factor.neutral))
    assert get_variation("real@1.0").ranges == get_variation("real").ranges


def test_a_draw_is_a_function_of_the_start_and_stays_in_its_range() -> None:
    variation = get_variation("hard")
    first, again, other = (variation.draw(entropy, ("cube",)) for entropy in (5, 5, 6))
    assert first == again != other
    for key, range_ in variation.ranges.items():
        for name, numbers in first.values.items():
            if name == key or name.startswith(f"{key}."):
                assert len(numbers) == FACTORS[key].size
                assert all(range_[0] - 1e-4 <= number <= range_[1] + 1e-4 for number in numbers)


def test_groups_draw_alone_what_they_draw_together() -> None:
    together = get_variation("real").draw(3, ("cube",)).values
    for group in ("objects", "robot", "start", "pushes", "scene"):
        alone = get_variation(f"real:{group}").draw(3, ("cube",)).values
        assert alone and alone.items() <= together.items()


def test_a_stronger_world_is_further_off_in_the_same_direction() -> None:
    weak, strong = (get_variation(f"real{at}:pushes").draw(4, ()).values["pushes.velocity"] for at in ("@0.5", ""))
    assert [2 * number for number in weak] == pytest.approx(strong, abs=2e-4)


def test_conditions_are_keys_of_an_initial_state() -> None:
    start = {"robot": [0.0, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}
    drawn = get_variation("real").draw(1, ("cube",))
    assert Conditions.read({**start, **drawn.write()}) == drawn
    assert not Conditions.read(start)


@pytest.mark.parametrize(
    ("state", "error", "words"),
    [
        ({"objects.masse.cube": [1.0]}, UnknownNameError, r"objects\.mass"),
        ({"objects.mass.cube": [1.0, 2.0]}, SceneError, "1 numbers"),
        ({"objects.mass.cube": [float("nan")]}, SceneError, "restore the start"),
        ({"robot.strength.waist": [-4.0]}, SceneError, "numbers from"),
        ({"robot.strength.left_foot": [1.0]}, UnknownNameError, "did you mean 'left_leg'"),
        ({"robot.strength": [1.0]}, UnknownNameError, "one of left_arm"),
        ({"start.arms.left": [0.0] * 14}, UnknownNameError, "expected one of no name"),
        ({"objects.mass": [1.0]}, UnknownNameError, "the name of an object"),
        ({"robot.seed": [float("nan")]}, SceneError, "0 or more"),
    ],
)
def test_damaged_conditions_are_refused(state: dict[str, list[float]], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Conditions.read(state)


def test_the_documentation_has_the_ranges() -> None:
    page = (REPOSITORY / Path("docs/variation.md")).read_text()
    assert page == filled(page), "run `python -m gym_demohlm.variation.table docs/variation.md`"

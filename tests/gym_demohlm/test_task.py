"""Tasks, regions and scenes: bounds, registry, and what a task file must not get wrong."""

import dataclasses
import inspect
import math
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from gym_demohlm import tasks
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.registry import all_tasks, get_task, register_task
from gym_demohlm.robot import g1
from gym_demohlm.scene import build_scene
from gym_demohlm.task import REGIONS, ObjectSpec, Region, Task, WideForm, limit_yaw
from tests.helpers.hold import HoldController

TASKS = sorted(all_tasks())
RANGES = [entry.name for entry in dataclasses.fields(Region)[1:]]


def test_regions_are_the_papers() -> None:
    assert REGIONS["R1"].robot_x == (-0.6, -0.3) and REGIONS["R1"].object_yaw == (-math.pi / 4, math.pi / 4)
    assert REGIONS["R2"].object_y == (0.0, 0.05) and REGIONS["R2"].robot_yaw == (-math.pi / 8, math.pi / 8)
    assert REGIONS["R3"].object_z == (-0.2, 0.0) and REGIONS["R3"].robot_y == (-0.3, 0.3)


@pytest.mark.parametrize("region", REGIONS.values(), ids=REGIONS)
def test_samples_fill_the_region_and_stay_inside(region: Region) -> None:
    rng = np.random.default_rng(0)
    states = [region.sample(rng) for _ in range(300)]
    values = np.array([[*state["robot"], *state["object"]] for state in states])
    for column, name in enumerate(RANGES):
        low, high = getattr(region, name)
        assert (values[:, column] >= low).all() and (values[:, column] <= high).all()
        assert np.ptp(values[:, column]) > 0.95 * (high - low)
    assert region.sample(np.random.default_rng(0)) == states[0]


def test_the_widest_region_reaches_further_in_every_way() -> None:
    inner, outer = REGIONS["R3"], get_task("LiftBox").region("R4")
    for name in ("robot_x", "robot_y", "robot_yaw", "object_y", "object_z", "object_yaw"):
        (low, high), (lowest, highest) = getattr(inner, name), getattr(outer, name)
        assert lowest <= low and high <= highest
    state = get_task("LiftBox").sample("R4", np.random.default_rng(0))
    assert -0.1 <= state["object_x"][0] <= 0.1
    assert get_task("PushCart").region("R4").object_z[1] == 0.05
    assert get_task("OpenCabinet").region("R4").object_yaw == (-math.pi / 4, math.pi / 4)


OBLONG, MARKED = {"LiftBox", "CarryBox"}, {"GraspCube", "PressCube", "Handover", "ExchangeCube"}


@pytest.mark.parametrize("name", TASKS)
def test_what_has_a_front_in_the_widest_region(name: str) -> None:
    """The paper's regions keep their task; in R4 boxes have two lengths and cubes a mark, and neither are symmetric."""
    task = get_task(name)
    assert all(task.at(region) is task for region in task.regions)
    wide = task.at("R4")
    assert (wide is task) == (name not in OBLONG | MARKED)
    if wide is task:
        return
    thing, turns = wide.objects[0], 2 if name in OBLONG else 1
    assert isinstance(thing.symmetry, tuple) and len(thing.symmetry) == turns < len(task.objects[0].symmetry)
    assert wide.at("R4") is wide and wide.region("R4") == task.region("R4")
    with pytest.raises(UnknownNameError, match="R3"):
        wide.sample("R3", np.random.default_rng(0))
    plain, other = build_scene(task), build_scene(wide)
    half, own = (scene.physics.geom(thing.name).size for scene in (plain, other))
    if name in OBLONG:
        assert thing.resized is not None
        assert tuple(2 * half) == pytest.approx(thing.resized[0]) and tuple(2 * own) == pytest.approx(thing.resized[1])
        assert own[0] < half[0] < own[1] and own[2] == half[2]
    else:  # a mark is seen and nothing else
        assert other.model.ngeom > plain.model.ngeom and other.physics.ngeom == plain.physics.ngeom
        np.testing.assert_array_equal(other.physics.body_mass, plain.physics.body_mass)
        np.testing.assert_array_equal(other.physics.body_inertia, plain.physics.body_inertia)
        np.testing.assert_array_equal(other.physics.geom_size, plain.physics.geom_size)


def test_a_wide_form_names_its_objects_as_the_task_does() -> None:
    task = get_task("LiftBox")
    form = WideForm(build=task.build, objects=(ObjectSpec(name="crate", position=(0.3, 0.0, 0.3)),))
    with pytest.raises(SceneError, match="crate"):
        dataclasses.replace(task, wide_form=form).at("R4")


def test_things_with_a_spread_are_placed_each_by_itself() -> None:
    task, rng = get_task("StackCube"), np.random.default_rng(0)
    states = [task.sample("R1", rng) for _ in range(50)]
    red, blue = (np.array([state[name] for state in states]) for name in ("red", "blue"))
    assert np.abs(np.corrcoef(red[:, 1], blue[:, 1])[0, 1]) < 0.4
    scene = build_scene(task)
    far = {**states[0], "red": [0.02, 0.01, 0.3], "blue": [-0.02, 0.0, 0.0]}
    near = {**far, "red": [0.0, 0.0, 0.0]}
    moved = np.flatnonzero(scene.place(far)[0] != scene.place(near)[0])
    address = scene.model.joint("red").qposadr[0]
    assert set(moved) <= set(range(address, address + 7)) and len(moved) >= 3
    with pytest.raises(UnknownNameError, match="green"):
        scene.place({**far, "green": [0.0, 0.0, 0.0]})


def test_regions_contain_one_another() -> None:
    for small, large in (("R1", "R2"), ("R2", "R3")):
        for name in RANGES:
            inner, outer = getattr(REGIONS[small], name), getattr(REGIONS[large], name)
            assert outer[0] <= inner[0] and inner[1] <= outer[1]


def test_a_task_may_limit_the_yaw() -> None:
    limited = limit_yaw(REGIONS, 1.0)
    assert limited["R3"].object_yaw == (-1.0, 1.0)
    assert limited["R1"] == REGIONS["R1"]


def test_bad_regions_and_objects_are_refused() -> None:
    with pytest.raises(SceneError, match="robot_y"):
        dataclasses.replace(REGIONS["R1"], robot_y=(0.1, -0.1))
    with pytest.raises(SceneError, match="robot_x"):
        dataclasses.replace(REGIONS["R1"], robot_x=(math.nan, 0.0))
    with pytest.raises(SceneError, match=r"0\.0 among them"):
        ObjectSpec(name="cube", position=(0, 0, 0), symmetry=(1.0,))
    task = get_task("LiftBox")
    with pytest.raises(UnknownNameError, match="lid"):
        dataclasses.replace(task, gaze_target="lid")
    with pytest.raises(UnknownNameError, match="middle"):
        dataclasses.replace(task, contact_pairs=(("middle", "box"),))
    with pytest.raises(SceneError, match="once"):
        dataclasses.replace(task, objects=task.objects * 2)
    with pytest.raises(SceneError, match="episode_length_s"):
        dataclasses.replace(task, episode_length_s=0.0)


@pytest.mark.parametrize("name", ["LiftBox", "LiftBox-v0", "DemoHLM/LiftBox-v0"])
def test_tasks_are_found_by_name(name: str) -> None:
    assert get_task(name) is all_tasks()["LiftBox"]


def test_an_unknown_name_is_explained() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'LiftBox'"):
        get_task("LiftBocks")
    with pytest.raises(UnknownNameError, match="R1, R2, R3"):
        get_task("LiftBox").sample("R9", np.random.default_rng())


@pytest.mark.parametrize("name", TASKS)
def test_every_task_is_registered_and_documented(name: str) -> None:
    task = get_task(name)
    assert f"DemoHLM/{name}-v0" in gym.registry
    module = inspect.getmodule(task.build)
    assert module is not None and module.__name__.startswith(tasks.__name__)
    assert inspect.getdoc(module)


@pytest.mark.parametrize("name", TASKS)
def test_every_start_in_every_region_is_sound(name: str) -> None:
    """At a sampled start, nothing is inside anything else, and the feet are on the floor."""
    task = get_task(name)
    scene = build_scene(task)
    data = mujoco.MjData(scene.model)
    rng = np.random.default_rng(1)
    for region in task.regions:
        for _ in range(20):
            data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = scene.place(task.sample(region, rng))
            mujoco.mj_fwdPosition(scene.model, data)
            assert all(contact.dist > -2e-3 for contact in data.contact)
            points = [f"{side}_foot_point_{index}" for side in g1.SIDES for index in range(len(g1.FOOT_POINTS))]
            lowest = min(data.geom(name).xpos[2] for name in points) - g1.FOOT_POINT_RADIUS
            assert abs(lowest) < 1e-9


def _empty_table(spec: mujoco.MjSpec) -> None:
    table = spec.worldbody.add_body(name="button", mocap=True)
    table.add_geom(name="button", size=[0.05, 0, 0], contype=0, conaffinity=0)


def test_a_task_from_outside_needs_nothing_else() -> None:
    task = Task(
        name="LookAtButton",
        description="Look at the button.",
        hands="gripper",
        build=_empty_table,
        objects=(ObjectSpec(name="button", position=(0.5, 0.0, 1.0), symmetry="any"),),
        success=lambda sim: sim.distance("right_palm", "button") < 0.05,
        gaze_target="button",
    )
    register_task(task)
    assert register_task(task) is get_task("LookAtButton")
    env = gym.make("DemoHLM/LookAtButton-v0", controller=HoldController(1))
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    env.step(env.action_space.sample())
    placed = env.unwrapped.sim.pose("button")[0, :3, 3]  # pyright: ignore[reportAttributeAccessIssue]
    dy, dz, _ = info["initial_state"]["object"]
    np.testing.assert_allclose(placed, [0.5, dy, 1.0 + dz])
    with pytest.raises(SceneError, match="second task"):
        register_task(dataclasses.replace(task, description="Another one."))


def test_a_module_may_bring_a_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [
        "from dataclasses import replace",
        "from gym_demohlm.registry import get_task, register_task",
        "register_task(replace(get_task('LiftBox'), name='LiftBoxAgain'))",
    ]
    (tmp_path / "brought_task.py").write_text("\n".join(lines))
    with pytest.raises(SceneError, match="brought_task"):
        get_task("brought_task:LiftBoxAgain")
    monkeypatch.syspath_prepend(tmp_path)
    assert get_task("brought_task:LiftBoxAgain") is get_task("LiftBoxAgain-v0")
    with pytest.raises(UnknownNameError, match="did you mean 'LiftBoxAgain'"):
        get_task("brought_task:LiftBoxAgai")


def _add_motor(spec: mujoco.MjSpec) -> None:
    _empty_table(spec)
    spec.add_actuator(name="extra", target="left_elbow_joint", trntype=mujoco.mjtTrn.mjTRN_JOINT)


def _fix_button(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_body(name="button").add_geom(size=[0.05, 0, 0])


@pytest.mark.parametrize(
    ("build", "message"), [(_add_motor, "extra"), (_fix_button, "mocap"), (lambda _: None, "button")]
)
def test_a_scene_that_does_not_fit_is_refused(build: object, message: str) -> None:
    task = Task(
        name="Wrong",
        description="Nothing.",
        hands="rubber",
        build=build,  # pyright: ignore[reportArgumentType]
        objects=(ObjectSpec(name="button", position=(0.5, 0.0, 1.0)),),
        success=lambda sim: sim.unstable,
        gaze_target="button",
    )
    with pytest.raises((SceneError, UnknownNameError), match=message):
        build_scene(task)

"""Worlds with models of their own: what conditions change, and that nothing else does."""

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.robot import g1
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState
from gym_demohlm.variation import Conditions, get_variation
from gym_demohlm.variation.surroundings import CLUTTER

TASK = get_task("GraspCube")
START: InitialState = {"robot": [-0.3, 0.0, 0.0], "object": [0.0, -0.05, 0.1]}


def varied(name: str, num_worlds: int = 1) -> Simulation:
    return Simulation(TASK, num_worlds, variation=get_variation(name))


def run(sim: Simulation, steps: int = 3) -> None:
    for _ in range(steps):
        sim.step(np.tile(command.rest(), (sim.num_worlds, 1)))


def test_conditions_change_the_model_of_their_world_alone() -> None:
    sim = varied("real", 2)
    conditions: InitialState = {
        "objects.size.cube": [1.1], "objects.mass.cube": [2.0], "robot.strength.left_leg": [0.8],
        "robot.gain.waist": [1.2], "robot.payload": [1.0], "scene.floor": [0.5],
    }  # fmt: skip
    sim.reset([START, {**START, **conditions}])
    plain, model = (sim.scene.world_models(sim.conditions(world))[0] for world in (0, 1))
    assert model.geom("cube").size == pytest.approx(1.1 * plain.geom("cube").size)
    assert model.body("cube").mass == pytest.approx(2.0 * plain.body("cube").mass)
    assert model.body("cube").inertia == pytest.approx(2.0 * 1.1**2 * plain.body("cube").inertia)
    assert model.body("torso_link").mass == pytest.approx(plain.body("torso_link").mass + 1.0)
    knee, waist = model.actuator("left_knee"), model.actuator("waist_yaw")
    assert knee.forcerange == pytest.approx(0.8 * plain.actuator("left_knee").forcerange)
    assert waist.gainprm[0] == pytest.approx(1.2 * plain.actuator("waist_yaw").gainprm[0])
    assert waist.biasprm[1:3] == pytest.approx(1.2 * plain.actuator("waist_yaw").biasprm[1:3])
    assert model.geom("floor").friction[0] == 0.5 and plain.geom("floor").friction[0] == 0.8
    rise = sim.pose("cube")[1, 2, 3] - sim.pose("cube")[0, 2, 3]
    assert rise == pytest.approx(0.1 * plain.geom("cube").size[2], abs=1e-6)
    sim.close()


def test_a_simulation_that_may_vary_leaves_plain_worlds_as_they_are() -> None:
    """Where no group adds bodies, a start without conditions has the bits of a plain simulation."""
    plain, sim = Simulation(TASK), varied("real:robot+start+pushes")
    for one in (plain, sim):
        one.reset([START])
        run(one)
    then, now = plain.snapshot(), sim.snapshot()
    assert now.keys() - then.keys() == {"targets"}
    assert all(np.array_equal(then[name], now[name]) for name in then)
    plain.close()
    sim.close()


def test_a_world_has_the_same_bits_alone_and_among_others_and_from_a_snapshot() -> None:
    together = varied("hard", 3)
    starts = [together.vary({**START, "robot": [-0.3, 0.01 * world, 0.0]}) for world in range(3)]
    together.reset(starts)
    run(together, 2)
    middle = together.snapshot()
    run(together, 2)
    end = together.snapshot()
    alone = varied("hard")
    alone.reset([starts[1]])
    run(alone, 4)
    assert all(np.array_equal(values[0], end[name][1]) for name, values in alone.snapshot().items())
    together.restore(middle)
    run(together, 2)
    assert all(np.array_equal(values, end[name]) for name, values in together.snapshot().items())
    assert not np.array_equal(end["physics"][0], end["physics"][1])
    alone.close()
    together.close()


def test_a_reset_compiles_no_model_for_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes as long as a tenth of an attempt."""
    sim = varied("real")
    monkeypatch.setattr(sim.scene, "shapes", lambda _: pytest.fail("drawn"))
    sim.reset([sim.vary(START)])
    run(sim)
    sim.close()


def test_conditions_are_a_function_of_task_and_start() -> None:
    sim, other = varied("real"), Simulation(get_task("PressCube"), variation=get_variation("real"))
    first = sim.vary(START)
    assert first == sim.vary(START) == sim.vary(first)
    assert Conditions.read(other.vary(START)) != Conditions.read(first)
    assert {key: first[key] for key in START} == START
    sim.close()
    other.close()


def test_a_push_changes_the_velocity_of_the_pelvis() -> None:
    sim = varied("real:pushes", 2)
    pauses = [0.1] + [100.0] * 15
    push: InitialState = {"pushes.pause": pauses, "pushes.velocity": [0.0, 0.4] + [0.0] * 30}
    still: InitialState = {"pushes.pause": pauses, "pushes.velocity": [0.0] * 32}
    sim.reset([{**START, **push}, {**START, **still}])
    run(sim, 1)
    assert np.array_equal(*sim.velocity("pelvis"))
    run(sim, 1)
    apart = np.diff(sim.velocity("pelvis")[:, 1])[0]
    assert abs(apart) > 0.05
    sim.close()


def test_encoders_err_within_their_bounds_and_servos_may_be_late() -> None:
    sim = varied("hard:robot", 2)
    sim.reset([{**START, "robot.encoder_bias": [0.015], "robot.encoder": [0.01], "robot.seed": [7.0]}, START])
    run(sim, 1)
    sensed, _ = sim.sensed_joints()
    error = sensed - sim.joint_positions
    assert 0.01 < np.abs(error[0]).max() <= 0.025 and not error[1].any()
    sim.reset([{**START, "robot.delay": [0.01]}, START])
    moving = np.tile(command.rest(), (2, 1))
    moving[:, command.ARMS] += 0.2
    sim.step(moving)
    elbow = g1.BODY_JOINTS.index("left_elbow")
    late, prompt = sim.joint_positions[:, elbow]
    assert 0.0 < late - g1.HOME[elbow] < prompt - g1.HOME[elbow]
    sim.close()


def test_conditions_of_an_object_that_is_not_there_are_refused() -> None:
    sim = Simulation(TASK, variation=get_variation("real"))
    with pytest.raises(UnknownNameError, match=r"'cub'.*did you mean 'cube'"):
        sim.reset([{**START, "objects.mass.cub": [2.0]}])
    sim.close()


def test_conditions_need_a_simulation_that_may_vary() -> None:
    sim = Simulation(TASK)
    with pytest.raises(SceneError, match="name its variation"):
        sim.reset([{**START, "objects.mass.cube": [2.0]}])
    sim.close()


@pytest.mark.parametrize("group", ["objects", "perception"])
def test_conditions_of_a_group_that_does_not_vary_are_refused_before_anything_changes(group: str) -> None:
    whole, sim = varied("real"), varied("real:pushes")
    start = whole.vary(START)
    kept = {key: numbers for key, numbers in start.items() if "." not in key or key.startswith(("pushes.", group))}
    before = sim.snapshot()
    with pytest.raises(SceneError, match=f"conditions of {group} in worlds of variation 'real:pushes'"):
        sim.reset([kept])
    assert all(np.array_equal(values, before[name]) for name, values in sim.snapshot().items())
    sim.reset([{key: numbers for key, numbers in kept.items() if not key.startswith(group)}])
    sim.close()
    whole.close()


@pytest.mark.parametrize("name", sorted(all_tasks()))
def test_furniture_collides_as_it_looks_and_cans_stand_on_tables(name: str) -> None:
    """Every visible geom of furniture under objects collides with robot and things; nothing is invisible."""
    task, scene = get_task(name), build_scene(get_task(name), variation=get_variation("real"))
    for support in task.supports:
        body = scene.model.body(support)
        for geom in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0]):
            assert (
                scene.model.geom_rgba[geom, 3] > 0 and scene.model.geom_conaffinity[geom] == g1.ROBOT_BIT | g1.WORLD_BIT
            )
    has_cans = any(scene.model.body(index).name == CLUTTER[0] for index in range(scene.model.nbody))
    assert has_cans == any("table" in support for support in task.supports)


@pytest.mark.parametrize("name", sorted(all_tasks()))
def test_models_of_worlds_are_laid_out_alike(name: str) -> None:
    """MuJoCo steps worlds together in memory of one size, whatever their conditions."""
    variation = get_variation("hard")
    scene = build_scene(get_task(name), variation=variation)
    model, untouched = scene.world_models(variation.draw(3, scene.loose))
    sizes = [size for size in dir(model) if size.startswith("n") and isinstance(getattr(model, size), int)]
    for size in sizes:
        assert getattr(model, size) == getattr(untouched, size) == getattr(scene.physics, size), size


@pytest.mark.parametrize("name", sorted(all_tasks()))
def test_varied_starts_are_sound(name: str) -> None:
    """At hard starts nothing is inside anything else by more than rounding and rubber allow, and cans stay standing."""
    task = get_task(name)
    sim = Simulation(task, 6, variation=get_variation("hard"))
    rng = np.random.default_rng(2)
    sim.reset([sim.vary(task.sample("R3", rng)) for _ in range(6)])
    for world in range(6):
        assert all(contact.dist > -2e-3 for contact in sim.mj_data(world).contact)
    sim.close()


@pytest.mark.parametrize("name", ["PressCube", "GraspCube", "ExchangeCube"])
def test_cans_stand_behind_what_has_a_front(name: str) -> None:
    """In R4, where cubes are marked, no can stands on the side from which the robot handles the cube."""
    task = get_task(name).at("R4")
    sim = Simulation(task, 16, variation=get_variation("real:scene"))
    rng = np.random.default_rng(4)
    sim.reset([sim.vary(task.sample("R4", rng)) for _ in range(16)])
    cube, turned = sim.pose("cube"), 0
    for can in CLUTTER:
        place = sim.pose(can)[:, :2, 3] - cube[:, :2, 3]
        near = np.linalg.norm(place, axis=1) < 0.3  # one without a free place stands far away
        ahead = (place * cube[:, :2, 0]).sum(axis=1)  # along the way from the robot to the cube
        assert near.any() and (ahead[near] > -0.06).all()
        turned += int((near & (cube[:, 0, 0] < 0.0)).sum())
    assert turned > 0
    sim.close()

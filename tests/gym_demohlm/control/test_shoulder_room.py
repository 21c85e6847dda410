"""How far shoulders roll inwards: as far as the trunk lets upper arms, and inverse kinematics keeps to it."""

import mujoco
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.control.shoulder_room import ShoulderRoom
from gym_demohlm.robot import g1, robot
from gym_demohlm.robot.physics import FIRST, SECOND, Physics

DT = 0.1
SIGN = {"left": -1.0, "right": 1.0}  # of a roll towards the trunk


def model(physics: Physics = SECOND) -> mujoco.MjModel:
    return robot.robot_spec("gripper", physics=physics).compile()


def depth(model: mujoco.MjModel, side: str, pitch: float, roll: float) -> float:
    """Distance of an upper arm from the trunk [m]; negative inside."""
    data = mujoco.MjData(model)
    data.joint(f"{side}_shoulder_pitch_joint").qpos = pitch
    data.joint(f"{side}_shoulder_roll_joint").qpos = roll
    mujoco.mj_kinematics(model, data)
    body = {name: model.body(name).id for name in (f"{side}_shoulder_yaw_link", "torso_link")}
    arm, trunk = ([geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == body[name]] for name in body)
    solid = [geom for geom in (*arm, *trunk) if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    return min(mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a in arm for b in trunk if {a, b} <= {*solid})


def narrowed(model: mujoco.MjModel, side: str, pitch: float) -> float:
    """The largest inward roll that a command may have after one with this pitch."""
    previous = command.rest()
    previous[command.NAMES.index(f"{side}_shoulder_pitch.pos")] = pitch
    bounds = ShoulderRoom(model).narrow(previous, command.LOWER, command.UPPER)
    return SIGN[side] * bounds[SIGN[side] > 0][command.NAMES.index(f"{side}_shoulder_roll.pos")]


@pytest.mark.parametrize("side", g1.SIDES)
@pytest.mark.parametrize("pitch", [-2.5, -1.33, -0.72, -0.25, 0.0, 0.41, 1.5])
def test_the_limit_is_where_the_trunk_begins(side: str, pitch: float) -> None:
    """Just outside of it the arm is free, a little further in the trunk stops it."""
    made = model()
    limit = narrowed(made, side, pitch)
    assert depth(made, side, pitch, SIGN[side] * limit) > -0.001
    assert depth(made, side, pitch, SIGN[side] * (limit + 0.04)) < 0.0


def test_nothing_else_is_narrowed() -> None:
    lower, upper = ShoulderRoom(model()).narrow(command.rest(), command.LOWER, command.UPPER)
    changed = [name for name, a, b in zip(command.NAMES, lower, command.LOWER, strict=True) if a != b]
    assert changed == ["left_shoulder_roll.pos"]
    changed = [name for name, a, b in zip(command.NAMES, upper, command.UPPER, strict=True) if a != b]
    assert changed == ["right_shoulder_roll.pos"]


def test_a_trunk_that_stops_no_arms_sets_no_limit() -> None:
    bounds = ShoulderRoom(model(FIRST)).narrow(command.rest(), command.LOWER, command.UPPER)
    np.testing.assert_array_equal(bounds, (command.LOWER, command.UPPER))


def test_inverse_kinematics_reaches_across_without_entering_the_trunk() -> None:
    """Upright in front of the belly, to the left: there the right upper arm was told to be 8 cm inside the trunk."""
    made = model()
    ik, previous = WholeBodyIK(made), command.rest()
    T_world_pelvis = poses.from_rotation(np.eye(3), [0.0, 0.0, g1.PELVIS_HEIGHT])
    target = poses.from_rotation(np.eye(3), [0.32, 0.05, 0.95])
    for _ in range(30):
        q = g1.HOME.copy()
        q[-14:] = previous[command.ARMS]
        solution = ik.solve(
            T_world_pelvis=T_world_pelvis, joint_positions=q, T_world_left=None, T_world_right=target, previous=previous
        )
        previous = solution.command
    pitch, roll = (previous[command.NAMES.index(f"right_shoulder_{axis}.pos")] for axis in ("pitch", "roll"))
    assert depth(made, "right", pitch, roll) > -0.005
    assert solution.position_error[1] < 0.02

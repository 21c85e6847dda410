"""The robot with either hand: its layout, its mass, its camera, and a cube held for five seconds."""

import mujoco
import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.robot import g1, hands, neck, robot

KINDS = pytest.mark.parametrize("kind", hands.HANDS)
ARMS = slice(len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS), None)


def compile_robot(kind: str) -> mujoco.MjModel:
    return robot.robot_spec(kind).compile()


def held_scene(kind: str, half_size: float, mass: float, position: np.ndarray) -> mujoco.MjModel:
    """A robot whose pelvis is fixed at standing height, and a free cube."""
    spec = robot.robot_spec(kind)
    spec.delete(spec.joint("floating_base_joint"))
    spec.body("pelvis").pos = [0, 0, g1.PELVIS_HEIGHT]
    cube = spec.worldbody.add_body(name="cube", pos=position)
    cube.add_freejoint()
    geom = cube.add_geom(name="cube", type=mujoco.mjtGeom.mjGEOM_BOX, size=[half_size] * 3, mass=mass, condim=4)
    geom.contype, geom.conaffinity = g1.WORLD_BIT, g1.ROBOT_BIT
    support = spec.add_equality(name="support", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    support.name1, support.name2, support.active = "world", "cube", False
    return spec.compile()


def set_body(model: mujoco.MjModel, data: mujoco.MjData, q: np.ndarray) -> None:
    for joint, angle in zip(g1.BODY_JOINTS, q, strict=True):
        data.joint(f"{joint}_joint").qpos = angle
        data.actuator(joint).ctrl = angle
    mujoco.mj_forward(model, data)


@KINDS
def test_actuators_come_in_the_documented_order(kind: str) -> None:
    model = compile_robot(kind)
    assert tuple(model.actuator(index).name for index in range(model.nu)) == robot.actuator_names(kind)
    for index, name in enumerate(g1.BODY_JOINTS + neck.NECK_JOINTS):
        assert model.actuator_trnid[index, 0] == model.joint(f"{name}_joint").id


@KINDS
def test_options_are_those_of_the_contact_study(kind: str) -> None:
    option = compile_robot(kind).opt
    assert (option.timestep, option.impratio) == (0.002, 10.0)
    assert option.noslip_iterations == {"rubber": 2, "gripper": 0}[kind]
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def test_unknown_hands_are_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"gripper, rubber.*did you mean 'gripper'"):
        robot.robot_spec("griper")


def test_neck_and_palms_leave_mass_and_balance_as_published() -> None:
    """At zero angles the robot with rubber hands weighs what the MJCF says, with the centre of mass where it was."""
    published, built = g1.read_mjcf().compile(), compile_robot("rubber")
    assert built.body_mass.sum() == pytest.approx(published.body_mass.sum(), abs=1e-9)
    centers = []
    for model in (published, built):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        centers.append(data.body("pelvis").subtree_com.copy())
    np.testing.assert_allclose(centers[0], centers[1], atol=1e-4)


def test_grippers_change_the_mass_by_less_than_a_tenth_of_a_kilogram() -> None:
    difference = compile_robot("gripper").body_mass.sum() - compile_robot("rubber").body_mass.sum()
    assert 0.0 < abs(difference) < 0.1


@KINDS
def test_left_and_right_mirror_each_other(kind: str) -> None:
    model = compile_robot(kind)
    data = mujoco.MjData(model)
    set_body(model, data, g1.HOME)
    left, right = (data.site(f"{side}_palm") for side in g1.SIDES)
    mirror = np.diag([1.0, -1.0, 1.0])
    np.testing.assert_allclose(left.xpos, mirror @ right.xpos, atol=1e-4)
    np.testing.assert_allclose(left.xmat.reshape(3, 3), mirror @ right.xmat.reshape(3, 3) @ mirror, atol=1e-3)


@KINDS
def test_home_pose_touches_nothing(kind: str) -> None:
    model = compile_robot(kind)
    data = mujoco.MjData(model)
    set_body(model, data, g1.HOME)
    assert data.ncon == 0


@KINDS
def test_sensors_agree_with_the_frames(kind: str) -> None:
    model = compile_robot(kind)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.qpos[:3], data.qpos[3:7] = rng.normal(size=3), [0.8, 0.0, 0.6, 0.0]
    data.qpos[7:] = rng.uniform(-0.3, 0.3, model.nq - 7)
    mujoco.mj_forward(model, data)
    for frame in robot.FRAMES:
        view = data.body(frame) if frame in robot.BODY_FRAMES else data.site(frame)
        np.testing.assert_allclose(data.sensor(f"{frame}_pos").data, view.xpos, atol=1e-12)
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, data.sensor(f"{frame}_quat").data)
        np.testing.assert_allclose(matrix, view.xmat, atol=1e-12)


def test_camera_looks_along_its_site() -> None:
    """The image axes of the camera are those of the site: -z forward (x), x right (-y), y up (z)."""
    model = compile_robot("rubber")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    R_site, R_camera = data.site("head_camera").xmat.reshape(3, 3), data.cam("head").xmat.reshape(3, 3)
    np.testing.assert_allclose(R_camera, np.stack([-R_site[:, 1], R_site[:, 2], -R_site[:, 0]], axis=1), atol=1e-12)
    np.testing.assert_allclose(data.cam("head").xpos, data.site("head_camera").xpos, atol=1e-12)
    np.testing.assert_allclose(R_site, np.eye(3), atol=1e-12)
    assert model.cam("head").fovy[0] == neck.CAMERA_FOVY


def test_positive_neck_angles_look_left_and_down() -> None:
    model = compile_robot("rubber")
    data = mujoco.MjData(model)
    data.joint("neck_yaw_joint").qpos, data.joint("neck_pitch_joint").qpos = 0.4, 0.7
    mujoco.mj_forward(model, data)
    forward = data.site("head_camera").xmat.reshape(3, 3)[:, 0]
    expected = [np.cos(0.7) * np.cos(0.4), np.cos(0.7) * np.sin(0.4), -np.sin(0.7)]
    np.testing.assert_allclose(forward, expected, atol=1e-12)


def test_neck_servos_reach_their_targets_and_stay_still() -> None:
    model = held_scene("rubber", 0.02, 0.01, np.array([5.0, 0, 0]))
    data = mujoco.MjData(model)
    set_body(model, data, g1.HOME)
    data.actuator("neck_yaw").ctrl, data.actuator("neck_pitch").ctrl = 0.5, 0.9
    mujoco.mj_step(model, data, nstep=500)
    assert data.joint("neck_yaw_joint").qpos[0] == pytest.approx(0.5, abs=0.01)
    assert data.joint("neck_pitch_joint").qpos[0] == pytest.approx(0.9, abs=0.02)
    assert abs(data.joint("neck_pitch_joint").qvel[0]) < 1e-3


@pytest.mark.parametrize("inside", [0.015, 0.03])
def test_rubber_palms_hold_a_cube_for_five_seconds(inside: float) -> None:
    """A cube of 1 kg, squeezed by arms whose commanded palms are `inside` its faces, once its support is gone."""
    half, place = 0.10, np.array([0.32, 0.0, 0.85])
    model = held_scene("rubber", half, 1.0, place)
    data = mujoco.MjData(model)
    set_body(model, data, arms_around(place, half))
    squeeze = arms_around(place, half - inside)
    for joint, angle in zip(g1.BODY_JOINTS, squeeze, strict=True):
        data.actuator(joint).ctrl = angle

    def p_palms_cube() -> np.ndarray:
        return data.body("cube").xpos - (data.site("left_palm").xpos + data.site("right_palm").xpos) / 2

    data.eq_active[model.equality("support").id] = 1
    mujoco.mj_step(model, data, nstep=500)
    before = p_palms_cube()
    data.eq_active[model.equality("support").id] = 0
    mujoco.mj_step(model, data, nstep=500)  # the arms sag under the load
    loaded = p_palms_cube()
    mujoco.mj_step(model, data, nstep=2500)
    assert np.linalg.norm(loaded - before) < 0.01
    assert np.linalg.norm(p_palms_cube() - loaded) < 0.0005
    touching = {model.geom(geom).name for contact in data.contact for geom in (contact.geom1, contact.geom2)}
    squeezed_to_the_core = {"left_palm_core", "right_palm_core"} if inside == 0.03 else set()
    assert touching == {"cube", "left_palm_pad", "right_palm_pad"} | squeezed_to_the_core


def arms_around(place: np.ndarray, half: float) -> np.ndarray:
    """Joint angles (29,) of a standing robot with its palms on both sides of a point, `half` away [m]."""
    ik = WholeBodyIK(compile_robot("rubber"))
    T_world_pelvis, targets = np.eye(4), [np.eye(4), np.eye(4)]
    T_world_pelvis[2, 3] = g1.PELVIS_HEIGHT
    for target, sign in zip(targets, (1, -1), strict=True):
        target[:3, 3] = place + np.array([0.0, sign * half, 0.0])
    q, previous = g1.HOME.copy(), command.rest()
    for _ in range(20):
        solution = ik.solve(
            T_world_pelvis=T_world_pelvis,
            joint_positions=q,
            T_world_left=targets[0],
            T_world_right=targets[1],
            previous=previous,
        )
        previous = solution.command
        q[ARMS] = previous[command.ARMS]
    assert solution.position_error.max() < 0.003
    return q


def gripper_over_cube() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A 4 cm cube of 0.2 kg between the open pads of the left gripper."""
    half = 0.02
    model = held_scene("gripper", half, 0.2, np.zeros(3))
    data = mujoco.MjData(model)
    set_body(model, data, g1.HOME)
    cube = data.joint(model.body_jntadr[model.body("cube").id])
    cube.qpos[:3] = data.site("left_palm").xpos
    mujoco.mju_mat2Quat(cube.qpos[3:7], data.site("left_palm").xmat)
    for jaw in ("jaw", "mirror"):
        data.joint(f"left_gripper_{jaw}_joint").qpos = hands.GRIPPER.stroke - half
    data.actuator("left_gripper").ctrl = 1.0
    mujoco.mj_forward(model, data)
    return model, data


def test_gripper_holds_a_cube_for_five_seconds_and_lets_go() -> None:
    model, data = gripper_over_cube()
    mujoco.mj_step(model, data, nstep=500)

    def p_palm_cube() -> np.ndarray:
        palm = data.site("left_palm")
        return palm.xmat.reshape(3, 3).T @ (data.body("cube").xpos - palm.xpos)

    settled = p_palm_cube()
    mujoco.mj_step(model, data, nstep=2500)
    assert np.linalg.norm(settled) < 0.01
    assert np.linalg.norm(p_palm_cube() - settled) < 0.002
    data.actuator("left_gripper").ctrl = 0.0
    mujoco.mj_step(model, data, nstep=500)
    assert data.body("cube").xpos[2] < data.site("left_palm").xpos[2] - 0.3


def test_pads_press_with_half_the_servo_force_each() -> None:
    model, data = gripper_over_cube()
    mujoco.mj_step(model, data, nstep=1000)
    press = dict.fromkeys(("left_gripper_jaw", "left_gripper_mirror"), 0.0)
    for index, contact in enumerate(data.contact):
        force = np.zeros(6)
        mujoco.mj_contactForce(model, data, index, force)
        for geom in (contact.geom1, contact.geom2):
            body = model.body(model.geom_bodyid[geom]).name
            if body in press:
                press[body] += force[0]
    for force in press.values():
        assert force == pytest.approx(hands.GRIPPER.force_limit / 2, rel=0.15)


def test_gripper_control_is_the_share_of_the_stroke() -> None:
    model = held_scene("gripper", 0.02, 0.1, np.array([5.0, 0, 0]))
    data = mujoco.MjData(model)
    set_body(model, data, g1.HOME)
    for share in (1.0, 0.3, 0.0):
        data.actuator("right_gripper").ctrl = share
        mujoco.mj_step(model, data, nstep=750)
        for jaw in ("jaw", "mirror"):
            travel = data.joint(f"right_gripper_{jaw}_joint").qpos[0] / hands.GRIPPER.stroke
            assert travel == pytest.approx(share, abs=0.02)


@KINDS
def test_hands_collide_with_each_other_and_the_thighs(kind: str) -> None:
    model = compile_robot(kind)
    pairs = [("left_thigh_collision", name) for name in hands.contact_geoms(kind, "left")]
    pairs += [(hands.contact_geoms(kind, "left")[0], hands.contact_geoms(kind, "right")[0])]
    for first, second in pairs:
        a, b = model.geom(first), model.geom(second)
        assert (a.contype[0] & b.conaffinity[0]) or (b.contype[0] & a.conaffinity[0])

"""Body, hands and neck -> the whole robot as one MjSpec, with actuators in a fixed order, sensors and options."""

import mujoco

from gym_demohlm.robot import g1, hands, neck
from gym_demohlm.robot.physics import PHYSICS, Physics
from gym_demohlm.timing import PHYSICS_DT

# Frames with sensors "<frame>_pos" (world position [m]) and "<frame>_quat" (world orientation, quat_wxyz).
BODY_FRAMES = ("pelvis", "torso_link")
SITE_FRAMES = ("left_palm", "right_palm", "head_camera", "left_sole", "right_sole")
FRAMES = BODY_FRAMES + SITE_FRAMES
# Frames with a sensor "<frame>_linvel" (world linear velocity [m/s]).
VELOCITY_FRAMES = ("pelvis", "left_palm", "right_palm", "left_sole", "right_sole")
GRIPPER_JOINTS = ("left_gripper_jaw", "right_gripper_jaw")


def robot_spec(kind: hands.Hands, physics: Physics | None = None) -> mujoco.MjSpec:
    """Return the robot alone: free joint ``floating_base_joint``, no floor, no light but its own.

    Actuators, in order: the 29 of `g1.BODY_JOINTS`, ``neck_yaw``, ``neck_pitch`` [rad], and with grippers
    ``left_gripper``, ``right_gripper`` (0 open .. 1 closed). Sensors: `FRAMES`, `VELOCITY_FRAMES` and ``pelvis_gyro``
    (angular velocity of the pelvis in its own frame [rad/s]). Options: those of `set_options`.

    Args:
        kind: "rubber" or "gripper".
        physics: ``PHYSICS`` by default.

    Raises:
        UnknownNameError: `kind` is neither.
    """
    physics = physics or PHYSICS
    spec = g1.load_body_spec(physics)
    spec.modelname = f"g1_{kind}"
    hands.add_hands(spec, kind)
    neck.add_neck(spec)
    neck.add_neck_actuators(spec)
    if kind == "gripper":
        hands.add_gripper_actuators(spec)
    _add_sensors(spec)
    set_options(spec, kind, physics)
    return spec


def set_options(spec: mujoco.MjSpec, kind: hands.Hands, physics: Physics) -> None:
    """Set the options under which hands hold without creeping: elliptic cone, impratio 10, implicitfast, 500 Hz.

    Grippers hold a cube or a bottle with a creep of 0.01 mm/s. Between soft rubber palms a box of 1 kg would creep by
    7 mm/s and turn without the no-slip pass: see ``docs/controller.md``, "The model". Without that pass, sparse
    matrices save a sixth of the time.
    """
    spec.option.timestep = PHYSICS_DT
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.noslip_iterations = physics.noslip_iterations if kind == "rubber" else 0
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    if not physics.islands:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND


def actuator_names(kind: hands.Hands) -> tuple[str, ...]:
    """Return the names of the actuators in their order."""
    grippers = tuple(f"{side}_gripper" for side in g1.SIDES) if kind == "gripper" else ()
    return g1.BODY_JOINTS + neck.NECK_JOINTS + grippers


def _add_sensors(spec: mujoco.MjSpec) -> None:
    kinds = mujoco.mjtSensor
    for frame in FRAMES:
        # XBODY is the body's own frame; BODY would be its centre of mass.
        objtype = mujoco.mjtObj.mjOBJ_XBODY if frame in BODY_FRAMES else mujoco.mjtObj.mjOBJ_SITE
        spec.add_sensor(name=f"{frame}_pos", type=kinds.mjSENS_FRAMEPOS, objtype=objtype, objname=frame)
        spec.add_sensor(name=f"{frame}_quat", type=kinds.mjSENS_FRAMEQUAT, objtype=objtype, objname=frame)
        if frame in VELOCITY_FRAMES:
            spec.add_sensor(name=f"{frame}_linvel", type=kinds.mjSENS_FRAMELINVEL, objtype=objtype, objname=frame)
    gyro_site = "imu_in_pelvis"
    spec.add_sensor(name="pelvis_gyro", type=kinds.mjSENS_GYRO, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=gyro_site)

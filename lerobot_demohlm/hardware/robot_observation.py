"""What a robot senses and where objects seem to be -> the observation of a policy, as the environment gives it."""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import attitude, features
from gym_demohlm.perception.estimate import UNSEEN, PoseEstimate
from gym_demohlm.robot import g1
from lerobot_demohlm.hardware.odometry import odometry_camera

_WAIST = slice(len(g1.LEG_JOINTS), len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS))


def agent_pos(state: np.void, servos: np.void | None) -> np.ndarray:
    """Return what the robot senses of itself, (68,) float32, see ``observation.STATE_NAMES``.

    Args:
        state: A record "state".
        servos: A record "servos"; neck and grippers at zero without one.
    """
    zero = np.zeros(2)
    neck, jaws, neck_dq, jaws_dq = (
        zero if servos is None else servos[name] for name in ("neck", "jaws", "neck_dq", "jaws_dq")
    )
    down = features.gravity(state["quat_wxyz"][None])
    roll, pitch = attitude.roll_pitch(attitude.in_torso(down, state["q"][None, _WAIST]))
    columns = [state["q"], neck, jaws, state["dq"], neck_dq, jaws_dq, roll, pitch]
    return np.concatenate(columns).astype(np.float32)


def objects(pose: np.void, state: np.void, servos: np.void | None) -> np.ndarray:
    """Return where objects are from the head camera as it is now, (MAX_OBJECTS, 4, 4).

    A look at them is some ten milliseconds old, and the head has moved since: odometry tells how. What was never seen
    is where the environment has it then (``UNSEEN``).

    Args:
        pose: A record "pose".
        state: A record "state".
        servos: A record "servos"; a neck at zero without one.
    """
    T_camera_then = poses.invert(odometry_camera(state, servos)) @ pose["T_odometry_camera"]
    known = np.isfinite(pose["age_s"])[:, None, None]
    return np.where(known, T_camera_then @ pose["T_camera_object"], poses.pose(UNSEEN))


def environment_state(pose: np.void, state: np.void, servos: np.void | None, count: int) -> np.ndarray:
    """Return the tracked objects, (9 count,) float32, see ``observation.environment_features``.

    Args:
        pose: A record "pose".
        state: A record "state".
        servos: A record "servos"; a neck at zero without one.
        count: Of the task's objects.
    """
    T = objects(pose, state, servos)[None, :count]
    shape = T.shape[:2]
    estimate = PoseEstimate(
        T_camera_object=T, valid=np.ones(shape, bool), age_s=np.zeros(shape), inliers=np.ones(shape)
    )
    return estimate.environment_state()[0]

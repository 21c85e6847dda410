"""What a robot senses and where objects seem to be -> the observation of a policy, as the environment gives it."""

import numpy as np

from gym_demohlm.control import attitude, features
from gym_demohlm.perception.estimate import PoseEstimate
from gym_demohlm.robot import g1

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


def environment_state(pose: np.void, count: int) -> np.ndarray:
    """Return the tracked objects, (9 count,) float32, see ``observation.environment_features``.

    Args:
        pose: A record "pose".
        count: Of the task's objects.
    """
    T = pose["T_camera_object"][None, :count]
    shape = T.shape[:2]
    estimate = PoseEstimate(
        T_camera_object=T, valid=np.ones(shape, bool), age_s=np.zeros(shape), inliers=np.ones(shape)
    )
    return estimate.environment_state()[0]

"""The G1's statics -> tables of ankle shifts that keep its centre of mass over its feet, and of how its joints sag."""

import mujoco
import numpy as np

from gym_demohlm.control import arm_load, leg_ik, reference
from gym_demohlm.robot import g1

SOLE_CENTRE = 0.03  # m ahead of the ankle: where the centre of mass should be; the sole reaches from -0.05 to 0.12
_SOLE_ENDS = (-0.04, 0.11)  # m ahead of the ankle: where the floor can push
_ANKLE_LIMIT = 0.84  # rad: the shank may lean this far forward
_PITCH_JOINTS = ("hip_pitch", "knee", "ankle_pitch")


class _Figure:
    """The robot standing on both feet, arms at home."""

    def __init__(self) -> None:
        self.model = g1.load_body_spec().compile()
        self.data = mujoco.MjData(self.model)
        self.address = [self.model.joint(f"{joint}_joint").qposadr[0] for joint in g1.BODY_JOINTS]

    def pose(self, height: float, pitch: float, leg: tuple[float, float, float]) -> float:
        """Take a posture [m, rad]; returns the centre of mass ahead of the pelvis [m]."""
        data, tilt = self.data, float(reference.pelvis_pitch(np.array(pitch)))
        hip, knee, ankle = leg
        joints = [hip, 0, 0, knee, ankle, 0]
        data.qpos[:] = 0
        data.qpos[2] = height
        data.qpos[3:7] = [np.cos(tilt / 2), 0, np.sin(tilt / 2), 0]
        data.qpos[self.address] = np.concatenate([joints, joints, [0, 0, pitch - tilt], g1.HOME[15:]])
        mujoco.mj_forward(self.model, data)
        return float(data.subtree_com[0, 0])

    def sag(self) -> np.ndarray:
        """Return how far hip pitch, knee and ankle pitch of one leg give under gravity [rad], (3,)."""
        model, data = self.model, self.data
        torque = data.qfrc_bias.copy()
        weight = model.body_subtreemass[1] * -model.opt.gravity[2]
        for side in g1.SIDES:
            foot = data.body(f"{side}_ankle_roll_link")
            ahead = np.clip(data.subtree_com[0, 0] - foot.xpos[0], *_SOLE_ENDS)
            point = foot.xpos + np.array([ahead, 0.0, -g1.SOLE_DROP])
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, point, foot.id)
            torque -= jacobian[2] * weight / 2
        return np.array(
            [
                torque[model.joint(f"left_{joint}_joint").dofadr[0]] / g1.motor(f"left_{joint}").stiffness
                for joint in _PITCH_JOINTS
            ]
        )


def tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what ``Reference`` takes: ankle shift [m] and sag [rad] for each height and torso pitch, arms at home.

    For each posture the shift with the centre of mass nearest the middle of the sole is taken, among those within the
    ankle's range of motion (or, where there is none, the one that exceeds it least). The sag is the torque that holds
    the posture over the joint's stiffness: hip pitch, knee, ankle pitch of each leg, weight on both.

    Returns:
        (heights, pitches), (heights, pitches, 3) and, for the arms, ``arm_table``.
    """
    figure = _Figure()
    shifts = np.linspace(-0.2, 0.25, 91)
    shape = (len(reference.TABLE_HEIGHTS), len(reference.TABLE_PITCHES))
    shift_table, sag_table = np.zeros(shape), np.zeros((*shape, len(_PITCH_JOINTS)))
    for i, height in enumerate(reference.TABLE_HEIGHTS):
        for j, pitch in enumerate(reference.TABLE_PITCHES):
            tilt = float(reference.pelvis_pitch(np.array(pitch)))
            down = np.full(len(shifts), height - g1.HIP_DROP * np.cos(tilt) - g1.SOLE_DROP)
            legs = np.stack(leg_ik.planar(shifts, down), axis=1) - np.array([tilt, 0.0, 0.0])
            behind = g1.HIP_DROP * np.sin(tilt)  # the hips lie behind the pelvis origin when it pitches forward
            costs = [
                abs(figure.pose(height, pitch, leg) - (shift - behind + SOLE_CENTRE))
                + 10 * max(-leg[2] - _ANKLE_LIMIT, 0.0)
                for shift, leg in zip(shifts, legs, strict=True)
            ]
            best = int(np.argmin(costs))
            figure.pose(height, pitch, legs[best])
            shift_table[i, j], sag_table[i, j] = shifts[best], figure.sag()
    return shift_table, sag_table, arm_table()


def arm_table() -> np.ndarray:
    """Return the first moment of the left arm's mass [kg m] as coefficients of ``arm_load.basis``, (81, 3)."""
    figure, rng = _Figure(), np.random.default_rng(0)
    model, data = figure.model, figure.data
    joints = rng.uniform(-np.pi, np.pi, (4 * arm_load.TABLE_SHAPE[0], arm_load.NUM_JOINTS))
    first = g1.BODY_JOINTS.index("left_shoulder_pitch")
    address = figure.address[first : first + arm_load.NUM_JOINTS]
    shoulder = model.body("left_shoulder_pitch_link").id
    moments = np.zeros((len(joints), 3))
    figure.pose(g1.PELVIS_HEIGHT, 0.0, (0.0, 0.0, 0.0))
    for row, angles in enumerate(joints):
        data.qpos[address] = angles
        mujoco.mj_forward(model, data)
        lever = data.subtree_com[shoulder] - data.body("torso_link").xpos
        moments[row] = model.body_subtreemass[shoulder] * (lever @ data.body("torso_link").xmat.reshape(3, 3))
    return np.linalg.lstsq(arm_load.basis(joints), moments, rcond=None)[0]


def torso_load() -> tuple[float, float]:
    """Return weight times lever [Nm] of what the waist carries, arms at home: upwards and ahead of the waist."""
    figure = _Figure()
    figure.pose(g1.PELVIS_HEIGHT, 0.0, (0.0, 0.0, 0.0))
    torso = figure.data.body("torso_link")
    weight = float(figure.model.body_subtreemass[torso.id] * -figure.model.opt.gravity[2])
    lever = figure.data.subtree_com[torso.id] - torso.xpos
    return weight * float(lever[2]), weight * float(lever[0])

"""The G1's statics -> tables of ankle shifts that keep its centre of mass over its feet, and of how its joints sag."""

import mujoco
import numpy as np

from gym_demohlm.control import arm_load, attitude, leg_ik, reference
from gym_demohlm.robot import g1

SOLE_CENTRE = 0.03  # m ahead of the ankle: where the centre of mass should be; the sole reaches from -0.05 to 0.12
_SOLE_ENDS = (-0.04, 0.11)  # m ahead of the ankle: where the floor can push
_ANKLE_LIMIT = 0.84  # rad: the shank may lean this far forward
_WAIST_BACK, _TILT_STEP = 0.45, 0.025  # rad: how far the waist bends back, and how finely that is tried
_BEHIND = 0.005  # m: so little is not behind
_SHIFTS = np.linspace(-0.2, 0.25, 91)  # m
_PITCH_JOINTS = ("hip_pitch", "knee", "ankle_pitch")


class _Figure:
    """The robot standing on both feet, arms at home."""

    def __init__(self) -> None:
        self.model = g1.load_body_spec().compile()
        self.data = mujoco.MjData(self.model)
        self.address = [self.model.joint(f"{joint}_joint").qposadr[0] for joint in g1.BODY_JOINTS]

    def pose(self, height: float, pitch: float, tilt: float, leg: tuple[float, float, float]) -> float:
        """Take a posture: height, pitch of torso and pelvis; returns the centre of mass ahead of the pelvis [m]."""
        data = self.data
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


def tables() -> tuple[np.ndarray, np.ndarray]:
    """Return what ``Reference`` takes: a posture for each height and torso pitch, arms at home, and the arms' weight.

    For each pelvis pitch, the ankle shift with the centre of mass nearest the middle of the sole is taken, among those
    within the ankle's range of motion (or, where there is none, the one that exceeds it least). The pelvis pitch is the
    comfortable one, or, where the centre of mass then stays behind, so much more that it does not, as far as the waist
    can bend back: that brings the upper body forward over the hips. The sag is the torque that holds the posture over
    the joint's stiffness: hip pitch, knee, ankle pitch of each leg, weight on both.

    Returns:
        (heights, pitches, 5) and, for the arms, ``arm_table``.
    """
    figure = _Figure()
    table = np.zeros((len(reference.TABLE_HEIGHTS), len(reference.TABLE_PITCHES), 2 + len(_PITCH_JOINTS)))
    for i, height in enumerate(reference.TABLE_HEIGHTS):
        for j, pitch in enumerate(reference.TABLE_PITCHES):
            tilt = attitude.comfortable_pitch(pitch)
            shift, leg, ahead = _best_stance(figure, height, pitch, tilt)
            while ahead < -_BEHIND and tilt + _TILT_STEP < pitch + _WAIST_BACK + 1e-9:
                tilt += _TILT_STEP
                shift, leg, ahead = _best_stance(figure, height, pitch, tilt)
            figure.pose(height, pitch, tilt, leg)
            table[i, j] = [shift, tilt, *figure.sag()]
    return table, arm_table()


def _best_stance(
    figure: _Figure, height: float, pitch: float, tilt: float
) -> tuple[float, tuple[float, float, float], float]:
    """Return the ankle shift [m], the leg's joints [rad], and how far ahead of the soles' middle the weight is [m]."""
    down = np.full(len(_SHIFTS), height - g1.HIP_DROP * np.cos(tilt) - g1.SOLE_DROP)
    legs = np.stack(leg_ik.planar(_SHIFTS, down), axis=1) - np.array([tilt, 0.0, 0.0])
    behind = g1.HIP_DROP * np.sin(tilt)  # the hips lie behind the pelvis origin when it pitches forward
    ahead = np.array([figure.pose(height, pitch, tilt, leg) for leg in legs]) - (_SHIFTS - behind + SOLE_CENTRE)
    best = int(np.argmin(np.abs(ahead) + 10 * np.maximum(-legs[:, 2] - _ANKLE_LIMIT, 0.0)))
    return float(_SHIFTS[best]), legs[best], float(ahead[best])


def arm_table() -> np.ndarray:
    """Return what ``ArmLoad`` takes: moment of the left arm and place of its hand as coefficients, (81, 6)."""
    figure, rng = _Figure(), np.random.default_rng(0)
    model, data = figure.model, figure.data
    joints = rng.uniform(-np.pi, np.pi, (4 * arm_load.TABLE_SHAPE[0], arm_load.NUM_JOINTS))
    first = g1.BODY_JOINTS.index("left_shoulder_pitch")
    address = figure.address[first : first + arm_load.NUM_JOINTS]
    shoulder, hand = model.body("left_shoulder_pitch_link").id, data.body("left_wrist_yaw_link")
    torso, rows = data.body("torso_link"), np.zeros((len(joints), arm_load.TABLE_SHAPE[1]))
    figure.pose(g1.PELVIS_HEIGHT, 0.0, 0.0, (0.0, 0.0, 0.0))
    for row, angles in enumerate(joints):
        data.qpos[address] = angles
        mujoco.mj_forward(model, data)
        points = np.stack([data.subtree_com[shoulder], hand.xpos + hand.xmat.reshape(3, 3) @ arm_load.HAND])
        moment, place = (points - torso.xpos) @ torso.xmat.reshape(3, 3)
        rows[row] = [*(model.body_subtreemass[shoulder] * moment), *place]
    return np.linalg.lstsq(arm_load.basis(joints), rows, rcond=None)[0]


def torso_load() -> tuple[float, float]:
    """Return weight times lever [Nm] of what the waist carries, arms at home: upwards and ahead of the waist."""
    figure = _Figure()
    figure.pose(g1.PELVIS_HEIGHT, 0.0, 0.0, (0.0, 0.0, 0.0))
    torso = figure.data.body("torso_link")
    weight = float(figure.model.body_subtreemass[torso.id] * -figure.model.opt.gravity[2])
    lever = figure.data.subtree_com[torso.id] - torso.xpos
    return weight * float(lever[2]), weight * float(lever[0])

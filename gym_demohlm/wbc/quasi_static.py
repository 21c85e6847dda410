"""The G1's kinematics -> the table of ankle shifts that keep its centre of mass over its feet."""

import mujoco
import numpy as np

from gym_demohlm.control import reference
from gym_demohlm.robot import g1

_SOLE_CENTRE = 0.03  # m ahead of the ankle: where the centre of mass should be; the sole reaches from -0.05 to 0.12
_ANKLE_LIMIT = 0.84  # rad: the shank may lean this far forward


def ankle_shift_table() -> np.ndarray:
    """Return the shift [m] for every height and torso pitch of the grid, arms at home: (heights, pitches).

    For each posture the shift with the centre of mass nearest the middle of the sole is taken, among those within the
    ankle's range of motion (or, where there is none, the one that exceeds it least).
    """
    model = g1.load_body_spec().compile()
    data = mujoco.MjData(model)
    address = [model.joint(f"{joint}_joint").qposadr[0] for joint in g1.BODY_JOINTS]
    shifts = np.linspace(-0.2, 0.25, 91)
    table = np.zeros((len(reference.TABLE_HEIGHTS), len(reference.TABLE_PITCHES)))
    for i, height in enumerate(reference.TABLE_HEIGHTS):
        for j, pitch in enumerate(reference.TABLE_PITCHES):
            tilt = float(reference.pelvis_pitch(np.array(pitch)))
            down = height - g1.HIP_DROP - g1.SOLE_DROP
            hip, knee, ankle = reference.leg_ik(shifts, np.full(len(shifts), down), np.full(len(shifts), tilt))
            costs = []
            for index, shift in enumerate(shifts):
                leg = np.array([hip[index], 0, 0, knee[index], ankle[index], 0])
                data.qpos[:] = 0
                data.qpos[2] = height
                data.qpos[3:7] = [np.cos(tilt / 2), 0, np.sin(tilt / 2), 0]
                data.qpos[address] = np.concatenate([leg, leg, [0, 0, pitch - tilt], g1.HOME[15:]])
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                hip_drop = g1.HIP_DROP * np.sin(tilt)  # the hips lie behind the pelvis origin when it pitches forward
                ankle_x = -hip_drop + shift
                error = data.subtree_com[0, 0] - (ankle_x + _SOLE_CENTRE)
                costs.append(abs(error) + 10 * max(-ankle[index] - _ANKLE_LIMIT, 0.0))
            table[i, j] = shifts[int(np.argmin(costs))]
    return table

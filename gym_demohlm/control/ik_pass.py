"""Targets of palms and head -> the nearest joint angles within bounds, by a few linearised least-squares problems."""

from dataclasses import dataclass

import mujoco
import numpy as np
import placo

from gym_demohlm.arithmetic import least_squares
from gym_demohlm.control.ik_settings import IKSettings
from gym_demohlm.control.kernels import ik as kernels

PALMS = ("left_palm", "right_palm")
_HEAD = "head_camera"


@dataclass(frozen=True, kw_only=True)
class Advance:
    """A pelvis that moves along its base's x as the robot squats and bends, see ``Reference.pelvis_ahead``.

    Attributes:
        ahead: (heights, pitches) how far ahead of its ankles it is [m].
        here: The same as it is now [m].
        pitch: Which joint is the torso's pitch; the first is the height.
    """

    ahead: np.ndarray
    here: float
    pitch: int


class Pass:
    """One problem: a robot on a base, the joints that may move, two palms with targets, a head and a posture.

    placo's own KinematicsSolver sums its tasks in the order of their memory addresses, so its last bits change from
    process to process. Here the weighted rows of all tasks form one matrix, in a fixed order.
    """

    def __init__(
        self, urdf_text: str, pulls: dict[str, tuple[float, float]], weights: tuple[float, float], settings: IKSettings
    ) -> None:
        """Load the robot.

        Args:
            urdf_text: Its description.
            pulls: For each joint that may move, in the order of all arrays, the angle [rad] or height [m] that it is
                pulled to, and the weight.
            weights: Pulls of a palm to its target position and orientation.
            settings: The other weights.
        """
        self.settings = settings
        self.robot = placo.RobotWrapper("", placo.Flags.ignore_collisions, urdf_text)
        self.posture, posture_weight = np.array(list(pulls.values())).T.copy()
        self._pull = np.sqrt(posture_weight)
        self.q_columns = np.array([self.robot.get_joint_offset(name) for name in pulls])
        self.v_columns = np.array([self.robot.get_joint_v_offset(name) for name in pulls])
        self.hand_scale, self._head_scale = np.sqrt(np.repeat(weights, 3)), np.sqrt(settings.head_weight)  # (6,)
        count, of_all = len(pulls), len(self.robot.state.qd)
        self._state = np.zeros(len(self.robot.state.q))
        self._jacobians = np.zeros((len(PALMS), 6, of_all))
        self._A, self._b = np.zeros((2 * count + 15, count)), np.zeros(2 * count + 15)  # two hands, a head

    def solve(
        self,
        T_world_base: np.ndarray,
        start: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        targets: list[np.ndarray | None],
        p_world_head: np.ndarray | None = None,
        advance: Advance | None = None,
    ) -> np.ndarray:
        """Return the joints nearest the targets, within [lower, upper], from `start` on; leave the robot there.

        Args:
            T_world_base: Pose of the base, (4, 4).
            start: The joints.
            lower: Their bounds.
            upper: Likewise.
            targets: Of the palms.
            p_world_head: Target position of the head [m].
            advance: How far the base then is ahead of `T_world_base` along its x.
        """
        q, base = start.copy(), np.zeros((3, len(start)))
        self._turn(T_world_base)
        self._place(T_world_base, q, base, advance)
        for _ in range(self.settings.iterations):
            change = self._step(q, lower, upper, targets, p_world_head, base)
            largest = kernels.move(change, q, lower, upper)
            self._place(T_world_base, q, base, advance)
            if largest < self.settings.converged:
                break
        return q

    def _turn(self, T_world_base: np.ndarray) -> None:
        """Give the base its orientation, which no joint changes."""
        quat_wxyz = np.zeros(4)
        mujoco.mju_mat2Quat(quat_wxyz, T_world_base[:3, :3].reshape(9))
        self._state[3:7] = quat_wxyz[[1, 2, 3, 0]]  # placo: x, y, z, w

    def _place(self, T_world_base: np.ndarray, q: np.ndarray, base: np.ndarray, advance: Advance | None) -> None:
        """Put the robot where its base advances to; write how the base moves with the joints, (3, n)."""
        state = self._state
        if advance is None:
            state[:3] = T_world_base[:3, 3]
        else:
            kernels.advanced(
                advance.ahead, advance.here, T_world_base, q[0], q[advance.pitch], advance.pitch, state, base
            )  # fmt: skip
        state[self.q_columns] = q
        self.robot.state.q = state
        self.robot.update_kinematics()

    def errors(self, targets: list[np.ndarray | None]) -> np.ndarray:
        """Return each palm's way to its target: translation [m] and rotation vector [rad] in the world, (2, 6)."""
        errors, quat_wxyz = np.zeros((2, 6)), np.zeros(4)
        for error, palm, target in zip(errors, PALMS, targets, strict=True):
            if target is not None:
                T = self.robot.get_T_world_frame(palm)
                error[:3] = target[:3, 3] - T[:3, 3]
                mujoco.mju_mat2Quat(quat_wxyz, (target[:3, :3] @ T[:3, :3].T).reshape(9))
                mujoco.mju_quat2Vel(error[3:], quat_wxyz, 1.0)
        return errors

    def _step(
        self,
        q: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        targets: list[np.ndarray | None],
        p_world_head: np.ndarray | None,
        base: np.ndarray,
    ) -> np.ndarray:
        """Solve one linearised problem for the change of the joints, with which the base moves by `base` (3, n).

        Levenberg-Marquardt with the error as damping (Sugihara 2011): a stretched arm stays still, not swinging. Most
        have their solution inside the bounds, where no solver for bounds is needed.
        """
        settings, robot = self.settings, self.robot
        hands = np.array([target is not None for target in targets])
        for jacobian, palm, target in zip(self._jacobians, PALMS, targets, strict=True):
            if target is not None:
                jacobian[:] = robot.frame_jacobian(palm, "local_world_aligned")
        rows = kernels.problem(
            q, self.posture, self._pull, self.v_columns, self.hand_scale, settings.regularization,
            settings.error_damping, hands, self.errors(targets), self._jacobians, base, self._A, self._b,
        )  # fmt: skip
        if p_world_head is not None:
            jacobian, T = robot.frame_jacobian(_HEAD, "local_world_aligned"), robot.get_T_world_frame(_HEAD)
            kernels.head_rows(
                self._head_scale, self.v_columns, jacobian, base, p_world_head, T, rows, self._A, self._b
            )  # fmt: skip
            rows += 3
        A, b = self._A[:rows], self._b[:rows]
        free = least_squares(A, b)
        if kernels.within(free, q, lower, upper):
            return free
        problem, residual = placo.Problem(), placo.Expression()
        change = problem.add_variable(len(q))
        residual.A, residual.b = A, -b
        # placo's comparisons make constraints, which its type stubs do not say.
        problem.add_constraint(residual == 0.0).configure("soft", 1.0)  # pyright: ignore[reportArgumentType]
        problem.add_constraint(change.expr() <= upper - q)  # pyright: ignore[reportArgumentType]
        problem.add_constraint(change.expr() >= lower - q)  # pyright: ignore[reportArgumentType]
        problem.solve()
        return np.array(change.value).reshape(-1)

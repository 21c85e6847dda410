"""Targets of palms and head -> the nearest joint angles within bounds, by a few linearised least-squares problems."""

from collections.abc import Callable

import mujoco
import numpy as np
import placo

from gym_demohlm.arithmetic import least_squares
from gym_demohlm.control.ik_settings import IKSettings

PALMS = ("left_palm", "right_palm")
_HEAD = "head_camera"


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
        self.posture, self.posture_weight = np.array(list(pulls.values())).T
        self.q_columns = [self.robot.get_joint_offset(name) for name in pulls]
        self.v_columns = [self.robot.get_joint_v_offset(name) for name in pulls]
        self.hand_scale = np.sqrt(np.repeat(weights, 3))  # (6,)

    def solve(
        self,
        T_world_base: np.ndarray,
        start: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        targets: list[np.ndarray | None],
        p_world_head: np.ndarray | None = None,
        advance: Callable[[np.ndarray], tuple[float, np.ndarray]] | None = None,
    ) -> np.ndarray:
        """Return the joints nearest the targets, within [lower, upper], from `start` on; leave the robot there.

        Args:
            T_world_base: Pose of the base, (4, 4).
            start: The joints.
            lower: Their bounds.
            upper: Likewise.
            targets: Of the palms.
            p_world_head: Target position of the head [m].
            advance: Joints -> how far the base is then ahead of `T_world_base` along its x [m]; its derivative (n,).
        """
        q = start.copy()
        base = self._place(T_world_base, q, advance)
        for _ in range(self.settings.iterations):
            change = self._step(q, lower, upper, targets, p_world_head, base)
            q = np.clip(q + change, lower, upper)
            base = self._place(T_world_base, q, advance)
            if np.abs(change).max() < self.settings.converged:
                break
        return q

    def _place(
        self, T_world_base: np.ndarray, q: np.ndarray, advance: Callable[[np.ndarray], tuple[float, np.ndarray]] | None
    ) -> np.ndarray:
        """Put the robot where its base advances to; return how the base moves with the joints, (3, n)."""
        if advance is None:
            self.move(T_world_base, q)
            return np.zeros((3, len(q)))
        T, (distance, slope) = T_world_base.copy(), advance(q)
        T[:3, 3] += distance * T[:3, 0]
        self.move(T, q)
        return np.outer(T[:3, 0], slope)

    def move(self, T_world_base: np.ndarray, q: np.ndarray) -> None:
        """Put the robot's base and joints where given."""
        state = np.zeros(len(self.robot.state.q))
        quat_wxyz = np.zeros(4)
        mujoco.mju_mat2Quat(quat_wxyz, T_world_base[:3, :3].reshape(9))
        state[:3], state[3:7] = T_world_base[:3, 3], quat_wxyz[[1, 2, 3, 0]]  # placo: x, y, z, w
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

        Most have their solution inside the bounds, where no solver for bounds is needed.
        """
        errors = self.errors(targets) * self.hand_scale
        # Levenberg-Marquardt with the error as damping (Sugihara 2011): a stretched arm stays still, not swinging.
        damping = self.settings.regularization + self.settings.error_damping * (errors**2).sum()
        rows = [np.diag(np.sqrt(self.posture_weight)), np.sqrt(damping) * np.eye(len(q))]
        values = [np.sqrt(self.posture_weight) * (self.posture - q), np.zeros(len(q))]
        for error, palm, target in zip(errors, PALMS, targets, strict=True):
            if target is not None:
                jacobian = self.robot.frame_jacobian(palm, "local_world_aligned")[:, self.v_columns]
                jacobian[:3] += base
                rows.append(self.hand_scale[:, None] * jacobian)
                values.append(error)
        if p_world_head is not None:
            scale = np.sqrt(self.settings.head_weight)
            jacobian = self.robot.frame_jacobian(_HEAD, "local_world_aligned")[:3, self.v_columns] + base
            rows.append(scale * jacobian)
            values.append(scale * (p_world_head - self.robot.get_T_world_frame(_HEAD)[:3, 3]))
        A, b = np.concatenate(rows), np.concatenate(values)
        free = least_squares(A, b)
        if (free <= upper - q).all() and (free >= lower - q).all():
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

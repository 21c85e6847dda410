"""Poses that an operator asks for -> commands, steps of one world, and rows of a demonstration; any row can be undone.

A world has the same bits after it has been restored, so going back costs nothing: what is recorded after it is as if
the first try had never been.
"""

import platform
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.ik import IKSolution, WholeBodyIK
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.errors import DemonstrationError
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation, StepResult
from gym_demohlm.task import InitialState
from lerobot_demohlm.datasets.facts import installed_versions
from lerobot_demohlm.demonstrations.demonstration import (
    ARRAYS,
    FORMAT_VERSION,
    Demonstration,
    measure,
    pose_numbers,
)
from lerobot_demohlm.generation.locomotion import LocomotionSettings, OffCourseError, walk
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView

APPROACH = 0.3  # m that the robot walks to where the operator takes over: so it stands as one that has walked
EXACT = LocomotionSettings(accept_m=0.035, accept_rad=0.08, max_walks=20, max_ticks=600)
SETTLE_TICKS = 10  # it stands still before

Row = dict[str, Any]


def take_over(sim: Simulation, start: InitialState) -> None:
    """Have the robot walk to where an operator takes over, and stand.

    Args:
        sim: One world.
        start: Where robot and objects shall be.

    Raises:
        DemonstrationError: The robot did not get there.
    """
    stance = np.array(start["robot"])
    behind = poses.to_planar(poses.planar(*stance) @ poses.planar(-APPROACH, 0.0, 0.0))
    sim.reset([start | {"robot": behind.tolist()}])
    try:
        for wanted in walk(lambda: sim.pose("pelvis")[0], stance, EXACT):
            sim.step(wanted[None])
    except OffCourseError as error:
        away = np.hypot(*(poses.to_planar(sim.pose("pelvis")[0]) - stance)[:2])
        raise DemonstrationError(
            f"a robot that stands {away:.3f} m from the operator's place after {EXACT.max_walks} walks or fewer",
            f"at most {EXACT.accept_m} m and {EXACT.accept_rad} rad",
            "start it where it has room to walk, or choose another --controller",
        ) from error
    for _ in range(SETTLE_TICKS):
        sim.step(command.rest()[None])


def scene_view(sim: Simulation, tick: int) -> SceneView:
    """Return what an operator sees of the first world."""
    return SceneView(
        tick=tick,
        T_world_head=sim.pose("head_camera")[0],
        T_world_pelvis=sim.pose("pelvis")[0],
        T_world_hands=np.stack([sim.pose(f"{side}_palm")[0] for side in g1.SIDES]),
        T_world_objects={entry.name: sim.pose(entry.name)[0] for entry in sim.task.objects},
    )


def solve(
    ik: WholeBodyIK,
    T_world_pelvis: np.ndarray,
    joint_positions: np.ndarray,
    asked: OperatorPoses,
    last: np.ndarray,
    walking: bool,
) -> tuple[np.ndarray, IKSolution]:
    """Return the command (23,) that does what an operator asks for, and what it leaves.

    Args:
        ik: The solver.
        T_world_pelvis: (4, 4) as measured.
        joint_positions: (29,) of the body joints as measured [rad].
        asked: Poses and velocity.
        last: (23,) the command before.
        walking: Whether the torso must stay where the controller lets it while it steps.
    """
    solution = ik.solve(
        T_world_pelvis=T_world_pelvis,
        joint_positions=joint_positions,
        T_world_left=asked.T_world_hands[0],
        T_world_right=asked.T_world_hands[1],
        T_world_head=asked.T_world_head,
        previous=last,
        walking=walking,
    )
    wanted = solution.command.copy()
    wanted[command.GRIPPERS] = asked.grippers
    wanted[command.VELOCITY] = asked.velocity
    return wanted.astype(np.float32).astype(np.float64), solution  # what is recorded is what is applied


class Recorder:
    """One world, the solver that moves it, and what has been recorded since ``begin``.

    Args:
        sim: One world, where the operator takes over.

    Attributes:
        sim: The world.
        rows: Recorded so far, one a step of 0.1 s; what ``Demonstration`` has of each step, and the torso's target.
        solution: Of the last step's inverse kinematics; None before the first.
    """

    def __init__(self, sim: Simulation) -> None:
        self.sim = sim
        self.model_hash = provenance.model_hash(sim.model)
        self._versions = installed_versions()  # reads files: not while the world runs
        controller = sim.controller
        self._controller_hash = controller.weights.hash if isinstance(controller, WholeBodyController) else ""
        self.rows: list[Row] = []
        self.solution: IKSolution | None = None
        self._ik = WholeBodyIK(sim.model)
        self._last = command.rest()  # the command before
        self._before: list[tuple[dict[str, np.ndarray], np.ndarray]] = []  # world and command before each row
        self._recording = False

    def __len__(self) -> int:
        """Return the number of recorded steps."""
        return len(self.rows)

    def restart(self) -> None:
        """Forget rows and command: the robot stands at rest, as ``take_over`` leaves it."""
        self.rows, self._before, self.solution = [], [], None
        self._last, self._recording = command.rest(), False

    def begin(self) -> None:
        """Record from now on."""
        self.rows, self._before, self._recording = [], [], True

    def view(self) -> SceneView:
        """Return what the operator sees."""
        return scene_view(self.sim, len(self.rows))

    def step(self, asked: OperatorPoses, *, walking: bool = False) -> StepResult:
        """Do what the operator asks for, for 0.1 s.

        Args:
            asked: Poses and velocity.
            walking: Whether the torso must stay where the controller lets it while it steps.
        """
        sim = self.sim
        pelvis, joints = sim.pose("pelvis")[0], sim.joint_positions[0]
        wanted, self.solution = solve(self._ik, pelvis, joints, asked, self._last, walking)
        return self.apply(wanted, asked)

    def apply(self, wanted: np.ndarray, asked: OperatorPoses) -> StepResult:
        """Carry out a command (23,) that was solved for these poses, now or in an earlier recording."""
        sim = self.sim
        row: Row = {}
        if self._recording:
            self._before.append((sim.snapshot(), self._last))
            row = measure(sim) | {
                "action": wanted.astype(np.float32),
                "hand_targets": pose_numbers(asked.T_world_hands),
                "head_target": None if asked.T_world_head is None else asked.T_world_head.copy(),
            }
        result = sim.step(wanted[None])
        self._last = wanted
        if self._recording:
            row["contact_forces"] = result.contact_forces[0].mean(axis=0)
            row["success"] = sim.success()[0]
            self.rows.append(row)
        return result

    def rewind(self, ticks: int) -> int:
        """Take back the last rows, the world with them; returns how many, at most all."""
        ticks = min(ticks, len(self.rows))
        if ticks > 0:
            snapshot, self._last = self._before[-ticks]
            self.sim.restore(snapshot)
            del self.rows[-ticks:], self._before[-ticks:]
            self.solution = None
        return ticks

    def demonstration(
        self,
        operator: str,
        start: InitialState,
        *,
        first: int = 0,
        last: int | None = None,
        facts: dict[str, Any] | None = None,
    ) -> Demonstration:
        """Return what was recorded.

        Args:
            operator: Who recorded it.
            start: Where the operator took over.
            first: Row that it begins with.
            last: Row after the one that it ends with; all rows by default.
            facts: More about it, for its metadata.

        Raises:
            DemonstrationError: There is no row.
        """
        rows = self.rows[first:last]
        if not rows:
            raise DemonstrationError("a recording without a step", "at least 1", "record, then stop")
        end = self.sim.snapshot() if last is None or last >= len(self.rows) else self._before[last][0]
        return Demonstration(
            task=self.sim.task.name,
            start=self._before[first][0],
            end=end,
            metadata={
                "format_version": FORMAT_VERSION,
                "task": self.sim.task.name,
                "operator": operator,
                "stance": start,
                "controller_hash": self._controller_hash,
                "model_hash": self.model_hash,
                "versions": dict(self._versions),
                "processor": platform.machine(),
            }
            | (facts or {}),
            **{name: np.stack([row[name] for row in rows]) for name in ARRAYS},  # pyright: ignore[reportArgumentType]
        )

    @property
    def last(self) -> np.ndarray:
        """(23,) the command before the next step."""
        return self._last.copy()

    def resume(self, snapshot: dict[str, np.ndarray], last: np.ndarray) -> None:
        """Stand where a recording began, with the command (23,) before it, and record from there."""
        self.sim.restore(snapshot)
        self._last = np.array(last, dtype=np.float64)
        self.solution = None
        self.begin()

"""Controls at 10 Hz and the buttons record, rewind, save, discard -> a demonstration that is known to be good.

The states::

    idle -> engaged -> recording -> review -> saved
                          ^   |        |
                          +---+        +--> idle (discarded)
                         rewind

While it is idle or engaged the robot moves and nothing is kept. A recording may go back by 2 s as often as one likes;
it then waits until the operator takes hold again. In review the world stands still and a trial shows what can be
generated from the recording.
"""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.controllers import DEFAULT
from gym_demohlm.errors import DemoHLMError, DemonstrationError
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState, Task
from gym_demohlm.timing import FPS, HOLD_STEPS
from lerobot_demohlm.demonstrations.demonstration import CONTACT_FORCE_N, Demonstration
from lerobot_demohlm.demonstrations.segmentation import contact_events, gripper_events, segment
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.teleop.clutch import Clutch, Controls
from lerobot_demohlm.teleop.journal import Found, Journal
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView
from lerobot_demohlm.teleop.recorder import Recorder, take_over
from lerobot_demohlm.teleop.trial import Trial, TrialReport, TrialSettings

IDLE, ENGAGED, RECORDING, REVIEW, SAVED = "idle", "engaged", "recording", "review", "saved"
BUTTONS = ("record", "rewind", "save", "discard")
REWIND_TICKS = 20  # 2 s
MAX_TICKS = 1200  # 2 minutes: a recording ends there
OUT_OF_REACH = 0.04  # m that a palm stays behind its target
SEGMENTS_EVERY = 5  # ticks between looks at how the recording would be cut
LEAD_TICKS = 3  # kept before the first motion
SETTLED_TICKS = 10  # after walking up to an object, the recording begins once the robot has stood for so long
MOVED_M = 0.01  # motion of a palm's target that counts

_log = logging.getLogger(__name__)


class SessionError(DemoHLMError):
    """A button that does nothing in the present state."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is known of a recording before it is saved.

    Attributes:
        contacts: Touches found.
        held: Whether the task had succeeded for the last second.
        refusal: Why it cannot be saved; empty where it can.
        trial: How the generated attempts stand; None where none are made.
    """

    contacts: int
    held: bool
    refusal: str
    trial: TrialReport | None


@dataclass(frozen=True, kw_only=True)
class Status:
    """What an operator needs to know now.

    Attributes:
        state: idle, engaged, recording, review or saved.
        paused: Whether the world stands still.
        tick: Steps recorded.
        engaged: Whether the left and the right palm follow a device.
        success: Whether the task's condition holds.
        held_s: How long it has held [s].
        fallen: Whether the robot has fallen.
        forces: Normal force of each contact pair [N], by ``side object``.
        contacts: What the hands have done so far: (tick, hand, kind, object).
        warnings: Sentences about reach, self-collision and the robot.
        segments: As the recording would be cut: (hand, kind, start, stop, object).
        verdict: In review; None elsewhere.
        message: What happened last, in a sentence.
        unfinished: Steps of a recording that a killed process left; 0 where there is none.
    """

    state: str
    paused: bool
    tick: int
    engaged: tuple[bool, bool]
    success: bool
    held_s: float
    fallen: bool
    forces: dict[str, float]
    contacts: tuple[tuple[int, str, str, str | None], ...]
    warnings: tuple[str, ...]
    segments: tuple[tuple[str, str, int, int, str | None], ...]
    verdict: Verdict | None
    message: str
    unfinished: int


@dataclass(kw_only=True)
class _Review:
    """A recording that has been stopped."""

    demonstration: Demonstration | None
    contacts: int
    held: bool
    refusal: str
    trial: Trial | None = None
    report: TrialReport | None = None


@dataclass(frozen=True, kw_only=True)
class SessionSettings:
    """How a session works.

    Attributes:
        scale: Metres of a palm for a metre of a hand.
        operator: Who records; written into the demonstration.
        trial: What is tried before saving; None for nothing.
        controller: Name, path or hash of the whole-body controller.
    """

    scale: float = 1.0
    operator: str = "person"
    trial: TrialSettings | None = field(default_factory=TrialSettings)
    controller: str = DEFAULT


class RecordingSession:
    """One task, one operator, one world, and what has been recorded in it.

    Args:
        task: The task.
        root: Where the demonstration goes; must not exist.
        start: Where robot and objects are when the operator takes over; the task's default if not given.
        sim: One world of the task; a new one if not given.
        settings: How it works.

    Raises:
        DemonstrationError: The root exists.
    """

    def __init__(
        self,
        task: Task,
        root: Path,
        start: InitialState | None = None,
        sim: Simulation | None = None,
        settings: SessionSettings | None = None,
    ) -> None:
        if Path(root).exists():
            raise DemonstrationError(f"the root {root}, which exists", "a new path", "choose another --root")
        self.task, self.root, self.settings = task, Path(root), settings or SessionSettings()
        self.start = start or task.default_state()
        self.sim = sim or Simulation(task, controller=self.settings.controller)
        self.recorder = Recorder(self.sim)
        self.clutch = Clutch(self.settings.scale)
        self.journal = Journal(self.root.with_name(f"{self.root.name}.unfinished"))
        self.state, self.message = IDLE, ""
        self._waiting = False  # after going back, until the operator takes hold
        self._review: _Review | None = None
        self._segments: list[Segment] = []
        self._touching = _SelfContacts(self.sim)
        self._asked: OperatorPoses | None = None
        self._held = 0
        take_over(self.sim, self.start)
        self._fresh = self.sim.snapshot()
        self.found: Found | None = self._unfinished()

    # What the operator does

    def press(self, button: str) -> None:
        """Do what a button stands for in the present state.

        Args:
            button: ``record`` begins a recording and ends it; ``rewind`` takes back 2 s; ``save`` writes it;
                ``discard`` begins anew; ``recover`` takes up what a killed process left.

        Raises:
            SessionError: It does nothing in this state.
            DemonstrationError: The recording cannot be saved, and why.
        """
        actions = {
            ("record", IDLE): self._begin,
            ("record", ENGAGED): self._begin,
            ("record", RECORDING): self._stop,
            ("rewind", RECORDING): self._rewind,
            ("rewind", REVIEW): self._rewind,
            ("save", REVIEW): self._save,
            ("discard", RECORDING): self._discard,
            ("discard", REVIEW): self._discard,
            ("discard", IDLE): self._discard,
            ("discard", ENGAGED): self._discard,
            ("recover", IDLE): self._recover,
            ("recover", ENGAGED): self._recover,
        }
        action = actions.get((button, self.state))
        if action is None:
            possible = sorted({name for name, state in actions if state == self.state})
            raise SessionError(
                f"{button!r} while the session is {self.state}",
                f"one of {', '.join(possible) or 'none'}",
                "press another",
            )
        action()

    @property
    def paused(self) -> bool:
        """Whether the world stands still."""
        return self._waiting or self.state in (REVIEW, SAVED)

    @property
    def held_s(self) -> float:
        """How long the task's condition has held [s]."""
        return self._held / FPS

    @property
    def targets(self) -> np.ndarray:
        """(2, 4, 4) what is asked of the palms; where they are, before anything was asked."""
        return self.recorder.view().T_world_hands if self._asked is None else self._asked.T_world_hands

    @property
    def recorded(self) -> Demonstration | None:
        """What would be saved, in review; None elsewhere, or where it cannot be."""
        return None if self._review is None or self._review.refusal else self._review.demonstration

    def view(self) -> SceneView:
        """Return what the operator sees."""
        return self.recorder.view()

    def __len__(self) -> int:
        """Return the number of recorded steps."""
        return len(self.recorder)

    def advance(self, controls: Controls) -> None:
        """Make a step of 0.1 s, or none while the world stands still.

        Args:
            controls: The newest.
        """
        if self._waiting and controls.active:
            self._waiting, self.message = False, "recording"
        if self.paused:
            return
        asked = self.clutch.poses(controls, self.recorder.view())
        self.carry_out(asked)

    def carry_out(self, asked: OperatorPoses) -> None:
        """Make a step of 0.1 s with poses from elsewhere, such as a scripted operator."""
        self._asked = asked
        result = self.recorder.step(asked, walking=bool(asked.velocity.any()))
        if self.state in (IDLE, ENGAGED):
            self.state = ENGAGED if any(self.clutch.engaged) else IDLE
        success = bool(self.sim.success()[0])
        self._held = self._held + 1 if success else 0
        if self.state != RECORDING:
            return
        row = self.recorder.rows[-1]
        self.journal.append(row["action"], row["hand_targets"], row["head_target"])
        if len(self.recorder) % SEGMENTS_EVERY == 0:
            self._segments = self._cut()
        if result.unstable[0] or self.sim.fallen()[0]:
            self.message = "the robot has fallen: rewind, or discard"
            self._wait()
        elif len(self.recorder) >= MAX_TICKS:
            self._stop()

    def status(self) -> Status:
        """Return what the operator needs to know now."""
        forces = {
            f"{side} {name}": round(float(self.sim.contact_force(side, name)[0]), 2)
            for side, name in self.task.contact_pairs
        }
        return Status(
            state=self.state,
            paused=self.paused,
            tick=len(self.recorder),
            engaged=self.clutch.engaged,
            success=self._held > 0,
            held_s=round(self.held_s, 1),
            fallen=bool(self.sim.fallen()[0]),
            forces=forces,
            contacts=tuple((e.tick, e.hand, e.kind, e.object) for e in self._events()),
            warnings=self._warnings(),
            segments=tuple((s.hand, s.kind, s.start, s.stop, s.object) for s in self._segments),
            verdict=self._verdict(),
            message=self.message,
            unfinished=0 if self.found is None else len(self.found.actions),
        )

    def close(self) -> None:
        """Release everything; what was being recorded stays on disk, to be taken up again."""
        self._end_trial()
        self.journal.close()
        self.sim.close()

    # Transitions

    def _begin(self) -> None:
        self.recorder.begin()
        self._segments, self.state, self.message = [], RECORDING, "recording"
        if self.found is not None:
            _log.warning("the unfinished recording of %d steps is dropped", len(self.found.actions))
            self.found = None
        facts = {
            "task": self.task.name,
            "model_hash": self.recorder.model_hash,
            "start": self.start,
            "operator": self.settings.operator,
        }
        self.journal.begin(self.sim.snapshot(), self.recorder.last, facts)

    def _stop(self) -> None:
        self.state, self._waiting = REVIEW, False
        self._segments = self._cut()
        review = self._judge()
        self._review = review
        if review.demonstration is not None and not review.refusal and self.settings.trial is not None:
            review.trial = Trial(
                task=self.task,
                demonstration=review.demonstration,
                settings=self.settings.trial,
                controller=self.settings.controller,
            )
            review.report = review.trial.report()
        self.message = review.refusal or "look at the trial, then save or discard"

    def _rewind(self) -> None:
        self._end_trial()
        self._review = None
        undone = self.recorder.rewind(REWIND_TICKS)
        self.journal.cut(len(self.recorder))
        self.state = RECORDING
        rows = self.recorder.rows
        self._held = _trailing([row["success"] for row in rows])
        self._segments = self._cut()
        self._let_go()
        self._wait()
        self.message = f"{undone / FPS:.1f} s taken back: take hold to go on"

    def _discard(self) -> None:
        self._end_trial()
        self._review, self._segments, self._waiting, self._held = None, [], False, 0
        self.journal.remove()
        self.found = None
        self.sim.restore(self._fresh)
        self.recorder.restart()
        self.clutch.reset()
        self._asked, self.state, self.message = None, IDLE, "discarded"

    def _save(self) -> None:
        review = self._review
        assert review is not None  # in review there is one
        verdict = self._verdict()
        assert verdict is not None
        refusal = verdict.refusal
        if not refusal and verdict.trial is not None and verdict.trial.hopeless:
            trial = verdict.trial
            reasons = ", ".join(f"{count} x {reason}" for reason, count in trial.reasons)
            refusal = trial.error or f"none of {trial.done} attempts generated from it succeeded ({reasons})"
        if refusal or review.demonstration is None:
            raise DemonstrationError(refusal or "nothing recorded", "one that can be generated from", "record it again")
        if verdict.trial is not None:
            report = verdict.trial
            review.demonstration.metadata["trial"] = {
                "region": self.settings.trial.region if self.settings.trial else "",
                "attempts": report.done,
                "successes": report.successes,
                "reasons": [list(entry) for entry in report.reasons],
            }
        self._end_trial()
        review.demonstration.save(self.root, self.task)
        self.journal.remove()
        self.state, self.message = SAVED, f"saved: {len(review.demonstration)} steps"

    def _recover(self) -> None:
        """Make the steps of an unfinished recording again, bit for bit, and stop behind them."""
        if self.found is None:
            raise SessionError("'recover' without an unfinished recording", "one", "record")
        found, self.found = self.found, None
        self.start = found.facts["start"]
        self.recorder.resume(found.start, found.last)
        for action, numbers, head in zip(found.actions, found.hand_targets, found.head_targets, strict=True):
            self._asked = _asked(action, numbers, head)
            self.recorder.apply(action.astype(np.float64), self._asked)
        self.journal.reopen(len(self.recorder))
        self._held = _trailing([row["success"] for row in self.recorder.rows])
        self._let_go()
        self._stop()

    # Details

    def _unfinished(self) -> Found | None:
        """Return what a killed process left, if it is of this task and model."""
        try:
            found = self.journal.find()
        except DemonstrationError as error:
            _log.warning("%s", error)
            return None
        if found is None:
            return None
        same = (found.facts.get("task"), found.facts.get("model_hash")) == (self.task.name, self.recorder.model_hash)
        if not same:
            _log.warning("%s is of another task or version: it stays there", self.journal.directory)
        return found if same else None

    def _wait(self) -> None:
        """Let the world stand still until the operator takes hold."""
        self._waiting = True

    def _let_go(self) -> None:
        """Have the clutch hold the targets of the last row."""
        rows = self.recorder.rows
        if rows:
            asked = _asked(rows[-1]["action"], rows[-1]["hand_targets"], rows[-1]["head_target"])
            self.clutch.reset(asked.T_world_hands, asked.grippers, asked.T_world_head)
        else:
            self.clutch.reset()

    def _end_trial(self) -> None:
        if self._review is not None and self._review.trial is not None:
            self._review.trial.close()
            self._review.trial = None

    def _events(self) -> list[Any]:
        rows = self.recorder.rows
        if not rows:
            return []
        found = contact_events(np.stack([row["contact_forces"] for row in rows]), self.task.contact_pairs)
        if self.task.hands == "gripper":
            found += gripper_events(np.stack([row["action"] for row in rows]))
        return sorted(found, key=lambda event: (event.tick, event.hand, event.kind))

    def _cut(self) -> list[Segment]:
        """Return how the recording would be cut as it stands; nothing before the first touch."""
        if not self.recorder.rows:
            return []
        try:
            return segment(self.recorder.demonstration(self.settings.operator, self.start), self.task)
        except DemonstrationError:
            return []

    def _judge(self) -> _Review:
        """Cut off what leads nowhere and say whether what remains can be saved."""
        rows = self.recorder.rows
        touches = [event for event in self._events() if event.kind == "touch"]
        success = np.array([bool(row["success"]) for row in rows], dtype=bool)
        last = last_held(success)
        held = last is not None
        review = _Review(demonstration=None, contacts=len(touches), held=held, refusal="")
        if not touches:
            review.refusal = f"a recording in which no hand touches anything with {CONTACT_FORCE_N} N or more for 0.2 s"
        elif last is None:
            review.refusal = "a recording that does not hold success for 1 s"
        else:
            first = first_row(rows, touches[0].tick)
            if touches[0].tick >= last:
                review.refusal = "a recording whose success comes before any touch"
                return review
            facts = {"cut": [first, len(rows) - last]}
            review.demonstration = self.recorder.demonstration(
                self.settings.operator, self._stance(first), first=first, last=last, facts=facts
            )
            try:
                segment(review.demonstration, self.task)
            except DemonstrationError as error:
                review.refusal = str(error)
        return review

    def _stance(self, first: int) -> InitialState:
        """Return where the robot stood before a row, with the objects' offsets of the start."""
        position, quat_wxyz = np.split(self.recorder.rows[first]["pelvis_pose"], [3])
        yaw = 2.0 * np.arctan2(quat_wxyz[3], quat_wxyz[0])
        robot = [float(position[0]), float(position[1]), float(yaw)]
        return self.start if first == 0 else self.start | {"robot": robot}

    def _verdict(self) -> Verdict | None:
        review = self._review
        if review is None:
            return None
        if review.trial is not None:
            review.report = review.trial.report()
        return Verdict(contacts=review.contacts, held=review.held, refusal=review.refusal, trial=review.report)

    def _warnings(self) -> tuple[str, ...]:
        found = []
        solution = self.recorder.solution
        if solution is not None:
            for side, left in zip(g1.SIDES, solution.planned_position_error, strict=True):
                if left > OUT_OF_REACH:
                    found.append(f"{side} hand out of reach by {100 * left:.0f} cm")
        found += [f"{first} presses on {second}" for first, second in self._touching.look()]
        if self.sim.fallen()[0]:
            found.append("the robot has fallen")
        return tuple(found)


class _SelfContacts:
    """Finds parts of the robot that touch each other."""

    def __init__(self, sim: Simulation) -> None:
        self._sim, self._model = sim, sim.scene.physics
        self._data = mujoco.MjData(self._model)
        body = self._model.geom_bodyid
        self._robot = self._model.body_rootid[body] == self._model.body_rootid[self._model.body("pelvis").id]

    def look(self) -> list[tuple[str, str]]:
        """Return the names of bodies that touch each other now."""
        self._data.qpos[:] = self._sim.qpos[0]
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        pairs = set()
        contacts = self._data.contact
        for first, second in contacts.geom[contacts.dist < 0.0].tolist():
            if self._robot[first] and self._robot[second]:
                names = sorted(_plain(self._model.body(self._model.geom_bodyid[geom]).name) for geom in (first, second))
                if names[0] != names[1]:
                    pairs.add((names[0], names[1]))
        return sorted(pairs)


def _plain(body: str) -> str:
    return body.removesuffix("_link").replace("_", " ")


def _asked(action: np.ndarray, hand_targets: np.ndarray, head: np.ndarray | None) -> OperatorPoses:
    """Return what an operator had asked for, from an action (23,), targets (2, 7) and the head's (4, 4) or None."""
    lost = head is None or not np.isfinite(head).all()
    return OperatorPoses(
        T_world_head=None if lost else head,
        T_world_hands=poses.pose(hand_targets[:, :3], hand_targets[:, 3:]),
        grippers=np.array(action[command.GRIPPERS], dtype=np.float64),
        velocity=np.array(action[command.VELOCITY], dtype=np.float64),
    )


def _trailing(success: list[Any]) -> int:
    """Return how many of the last steps succeeded without a break."""
    failed = np.flatnonzero(~np.array(success, dtype=bool))
    return len(success) - (int(failed[-1]) + 1 if len(failed) else 0)


def last_held(success: np.ndarray) -> int | None:
    """Return the last row behind ten (1 s) that all succeeded, of (T,) bool; None where there are none."""
    sums = np.convolve(success.astype(np.int64), np.ones(HOLD_STEPS, dtype=np.int64), "valid")
    held = np.flatnonzero(sums == HOLD_STEPS)
    return int(held[-1]) + HOLD_STEPS if len(held) else None


def first_row(rows: list[dict[str, Any]], first_touch: int) -> int:
    """Return the row with which a demonstration begins: after a walk up to the object, and just before hands move.

    Args:
        rows: Of the recording.
        first_touch: Tick of the first touch.
    """
    velocity = np.array([row["action"][command.VELOCITY] for row in rows[:first_touch]]).reshape(-1, 3)
    walked = np.flatnonzero(np.abs(velocity).max(axis=1, initial=0.0) > 0.0)
    first = 0 if len(walked) == 0 else min(int(walked[-1]) + 1 + SETTLED_TICKS, first_touch)
    targets = np.stack([row["hand_targets"][:, :3] for row in rows[first : first_touch + 1]])
    moved = np.flatnonzero(np.linalg.norm(targets - targets[0], axis=2).max(axis=1) > MOVED_M)
    return first + max(0, int(moved[0]) - LEAD_TICKS) if len(moved) else first

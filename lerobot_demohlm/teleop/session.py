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

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.controllers import DEFAULT
from gym_demohlm.errors import DemoHLMError, DemonstrationError
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState, Task
from gym_demohlm.timing import FPS
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.teleop.clutch import Clutch, Controls
from lerobot_demohlm.teleop.journal import Found, Journal
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView
from lerobot_demohlm.teleop.recorder import Recorder, take_over
from lerobot_demohlm.teleop.review import Review, events, judge
from lerobot_demohlm.teleop.self_contacts import SelfContacts
from lerobot_demohlm.teleop.status import ENGAGED, IDLE, RECORDING, REVIEW, SAVED, Status, Verdict
from lerobot_demohlm.teleop.trial import Trial, TrialSettings

BUTTONS = ("record", "rewind", "save", "discard")
REWIND_TICKS = 20  # 2 s
MAX_TICKS = 1200  # 2 minutes: a recording ends there
OUT_OF_REACH = 0.04  # m that a palm stays behind its target
SEGMENTS_EVERY = 5  # ticks between looks at how the recording would be cut

_log = logging.getLogger(__name__)


class SessionError(DemoHLMError):
    """A button that does nothing in the present state."""


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
        self._waiting = False  # after going back, until the operator takes hold again
        self._released = True  # whether the operator has let go since
        self._review: Review | None = None
        self._segments: list[Segment] = []
        self._touching = SelfContacts(self.sim)
        self._asked: OperatorPoses | None = None
        self._before: tuple[OperatorPoses | None, float] = (None, 0.0)  # poses and squat as the recording began
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
        """What would be saved, in review, or was; None elsewhere, or where it cannot be."""
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
        self._released = self._released or not controls.active
        if self._waiting and self._released and controls.active:
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
        row["squat"] = self.clutch.squat
        try:
            self.journal.append(row["action"], row["hand_targets"], row["head_target"])
        except OSError as error:
            self.message = f"{self.journal.directory}: {error.strerror or error}; make room, then take hold to go on"
            self._wait()
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
            grippers=self.clutch.grippers,
            success=self._held > 0,
            held_s=round(self.held_s, 1),
            fallen=bool(self.sim.fallen()[0]),
            forces=forces,
            contacts=tuple((e.tick, e.hand, e.kind, e.object) for e in events(self.recorder.rows, self.task)),
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
        kept = self._keep_unfinished()
        facts = {**self._replayed_by, "start": self.start, "operator": self.settings.operator}
        self.journal.begin(self.sim.snapshot(), self.recorder.last, facts)
        self.recorder.begin()
        self._before = self._asked, self.clutch.squat
        self._segments, self.state, self.message = [], RECORDING, f"recording{kept}"

    def _stop(self) -> None:
        self.state, self._waiting = REVIEW, False
        self._segments = self._cut()
        review = self._review = judge(self.recorder, self.task, self.settings.operator, self.start)
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
        kept = self._keep_unfinished()
        self.journal.remove()
        self.sim.restore(self._fresh)
        self.recorder.restart()
        self.clutch.reset()
        self._asked, self._before, self.state, self.message = None, (None, 0.0), IDLE, f"discarded{kept}"

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
            } | ({"error": report.error} if report.error else {})
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
            lowered = float(action[command.HEIGHT] - command.rest()[command.HEIGHT])
            self.recorder.rows[-1]["squat"] = 0.0 if self._asked.T_world_head is None else lowered
        self.journal.reopen(len(self.recorder))
        self._held = _trailing([row["success"] for row in self.recorder.rows])
        self._let_go()
        self._stop()

    # Details

    def _unfinished(self) -> Found | None:
        """Return what a killed process left, if it can be made again here; what cannot be is set aside."""
        try:
            found = self.journal.find()
        except DemonstrationError as error:
            _log.warning("%s; it is kept as %s", error, self.journal.set_aside())
            return None
        if found is None:
            return None
        if any(found.facts.get(name) != value for name, value in self._replayed_by.items()):
            what = "an unfinished recording of another task, version or controller"
            _log.warning("%s: %s is kept as %s", self.journal.directory, what, self.journal.set_aside())
            return None
        return found

    def _keep_unfinished(self) -> str:
        """Set an unfinished recording aside that was not taken up; returns what to say of it."""
        if self.found is None:
            return ""
        self.found = None
        kept = self.journal.set_aside()
        _log.warning("the unfinished recording is kept as %s; to take it up, name it %s", kept, self.journal.directory)
        return f"; the unfinished recording is kept as {kept.name}"

    @property
    def _replayed_by(self) -> dict[str, str]:
        """Return what must be the same for a recording's steps to be the same."""
        return {
            "task": self.task.name,
            "model_hash": self.recorder.model_hash,
            "controller_hash": provenance.controller_hash(self.settings.controller),
        }

    def _wait(self) -> None:
        """Let the world stand still until the operator, who may not have let go yet, takes hold again."""
        self._waiting, self._released = True, False

    def _let_go(self) -> None:
        """Have the clutch hold the targets of the last row, or those with which the recording began."""
        rows = self.recorder.rows
        asked, squat = self._before
        if rows:
            asked = _asked(rows[-1]["action"], rows[-1]["hand_targets"], rows[-1]["head_target"])
            squat = rows[-1]["squat"]
        if asked is None:
            self.clutch.reset()
        else:
            self.clutch.reset(asked.T_world_hands, asked.grippers, asked.T_world_head, squat)

    def _end_trial(self) -> None:
        if self._review is not None and self._review.trial is not None:
            self._review.trial.close()
            self._review.trial = None

    def _cut(self) -> list[Segment]:
        """Return how the recording would be cut as it stands; nothing before the first touch."""
        if not self.recorder.rows:
            return []
        try:
            return segment(self.recorder.demonstration(self.settings.operator, self.start), self.task)
        except DemonstrationError:
            return []

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

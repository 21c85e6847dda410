"""A scripted operator -> one that moves as a person does: late, trembling, pausing, overshooting, losing tracking.

It stands in for a person with a headset, and goes the whole way of one: poses of devices in a room of its own, at the
rate of a headset, through the slot that a server keeps the newest in, the clutch, and a recording session. It knows no
more of the clutch than that a motion of the hand is a motion of the palm's target, watches that target as the page
shows it, and leads it back where it has gone astray. It tells a target that is late from an arm that sags, and holds
on once its script is over. What it does is a function of its seed.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gym_demohlm import poses
from gym_demohlm.errors import DemonstrationError
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from gym_demohlm.timing import HOLD_S, STEP_DT
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.teleop.clutch import DEAD_ZONE, WALK_SPEED, Controls, HandControls
from lerobot_demohlm.teleop.operator import Operator, OperatorPoses, SceneView
from lerobot_demohlm.teleop.record import script_of
from lerobot_demohlm.teleop.session import MAX_TICKS, RecordingSession, SessionSettings
from lerobot_demohlm.teleop.status import REVIEW
from lerobot_demohlm.teleop.web import protocol
from lerobot_demohlm.teleop.web.inputs import Inputs

STREAM = 4  # first number of its seed sequences, as those of starts, noise and stances are others
HEADSET_HZ = 72
FINE = 10  # points of a hand's way a step
WATCHING_GAIN = 0.2  # share of what a target is off that a person makes up for each step
WAITING_M = 0.03  # a person waits for a target that is further off
TREMOR_HZ = (4.0, 12.0)
WAVES = 4  # sinusoids of a tremor, an axis
MAX_TRIES = 10  # recordings after which a person gives up
AT_END_TICKS = 40  # a person waits so long for success to last


@dataclass(frozen=True, kw_only=True)
class Person:
    """How somebody moves.

    Attributes:
        delay_s: From a motion to its message [s].
        tremor_m: Root mean square length of the hands' tremor [m].
        tremor_rad: The same of its turn [rad].
        frequency: Of the hand as a spring that follows what the person intends [rad/s].
        damping: Of that spring; below 1 it overshoots.
        yaw: Heading of the person in the room [rad].
        pauses: Steps of the script at which the person stops, and for how many steps.
        regrips: Steps of the script at which the person lets go of the clutch, for how many steps, and goes on from
            elsewhere in the room.
        losses: Steps of the script at which tracking of a hand is lost, for how many steps, and which hand.
    """

    delay_s: float
    tremor_m: float
    tremor_rad: float
    frequency: float
    damping: float
    yaw: float
    pauses: tuple[tuple[int, int], ...]
    regrips: tuple[tuple[int, int], ...]
    losses: tuple[tuple[int, int, int], ...]


def draw_person(rng: np.random.Generator) -> Person:
    """Draw how somebody moves: the first of each kind of trouble comes early enough to happen in every task."""
    early, late = (5, 50), (5, 130)

    def tick(index: int) -> int:
        return int(rng.integers(*(early if index == 0 else late)))

    return Person(
        delay_s=float(rng.uniform(0.06, 0.15)),
        tremor_m=0.005,
        tremor_rad=0.02,
        frequency=float(rng.uniform(6.0, 9.0)),
        damping=float(rng.uniform(0.45, 0.7)),
        yaw=float(rng.uniform(-math.pi, math.pi)),
        pauses=tuple((tick(index), int(rng.integers(4, 16))) for index in range(2)),
        regrips=tuple((tick(index), int(rng.integers(3, 7))) for index in range(2)),
        losses=tuple((tick(index), int(rng.integers(2, 9)), int(rng.integers(2))) for index in range(2)),
    )


class _Tremor:
    """A sum of sinusoids in each of some axes.

    Args:
        rms: Root mean square length of it.
        axes: Number of axes.
        rng: Draws frequencies and phases.
    """

    def __init__(self, rms: float, axes: int, rng: np.random.Generator) -> None:
        self._rate = 2.0 * math.pi * rng.uniform(*TREMOR_HZ, (axes, WAVES))
        self._phase = rng.uniform(0.0, 2.0 * math.pi, (axes, WAVES))
        self._size = rms * math.sqrt(2.0 / (axes * WAVES))

    def at(self, time_s: float) -> np.ndarray:
        """Return it at a time, (axes,)."""
        return self._size * np.sin(self._rate * time_s + self._phase).sum(axis=1)


class PerturbedOperator:
    """A scripted operator whose poses come out of a person's hands.

    Args:
        script: What the person intends.
        person: How they move.
        rng: Draws tremor and where hands are taken back to.
    """

    def __init__(self, script: Operator, person: Person, rng: np.random.Generator) -> None:
        self._script, self._person, self._rng = script, person, rng
        self._tremors = [(_Tremor(person.tremor_m, 3, rng), _Tremor(person.tremor_rad, 3, rng)) for _ in g1.SIDES]
        self._R_room_heading = poses.planar(0.0, 0.0, person.yaw)[:3, :3]
        self._intended: OperatorPoses | None = None
        self._grippers = np.zeros(len(g1.SIDES))
        self._goals: list[np.ndarray] = []  # (2, 4, 4) intended, in the world or, once it walks, on the robot
        self._walked = False
        self._hands = np.zeros((len(g1.SIDES), 3))  # m, in the room's axes: where the spring is
        self._speeds = np.zeros((len(g1.SIDES), 3))  # m/s
        self._aims = np.zeros((len(g1.SIDES), 3))  # m, in the room's axes: where the person means the hand to be
        self._turns = np.tile(np.eye(3), (len(g1.SIDES), 1, 1))  # of the hands in the room
        self._ways: list[np.ndarray] = [self._hands.copy()]  # FINE points a step
        self._turned: list[np.ndarray] = [self._turns.copy()]  # one a step
        self._held: list[Controls] = [Controls()]  # buttons and sticks, one a step
        self._script_tick, self._waiting, self._released = 0, 0, 0
        self._lost = np.zeros(len(g1.SIDES), dtype=np.int64)
        self.over = False

    def move(self, view: SceneView, targets: np.ndarray) -> None:
        """Decide on the next step of 0.1 s.

        Args:
            view: What is seen now.
            targets: (2, 4, 4) of the palms, as the page shows them.
        """
        person = self._person
        heading = poses.planar(*poses.to_planar(view.T_world_pelvis))
        frame = heading if self._walked else np.eye(4)
        seen = poses.invert(frame) @ targets
        lag = max(1, round(person.delay_s / STEP_DT) + 1)
        before = self._goals[-1] if self._goals else seen
        missed = (self._goals[-lag] - seen)[:, :3, 3] if len(self._goals) >= lag else np.zeros((2, 3))
        self._advance(view, targets, missed)
        intended = self._intended
        goal = before if intended is None else poses.invert(frame) @ intended.T_world_hands
        if intended is not None and intended.velocity.any() and not self._walked:
            self._walked = True
            self._goals.clear()  # from now on they are on the robot
            goal = poses.invert(heading) @ intended.T_world_hands
            before, missed, frame = goal, np.zeros((2, 3)), heading
        self._goals.append(goal)
        # A motion in the world, in the robot's heading, in the room.
        R = self._R_room_heading @ heading[:3, :3].T @ frame[:3, :3]
        hands_off = self._released > 0
        if not hands_off:
            self._aims += ((goal - before)[:, :3, 3] + WATCHING_GAIN * missed) @ R.T
            astray = goal[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)
            if len(self._goals) > lag:
                off = self._goals[-1 - lag][:, :3, :3] @ np.swapaxes(seen[:, :3, :3], 1, 2)
                off = poses.rotation_from_vector(WATCHING_GAIN * poses.rotation_vector(off))
                astray = off @ astray
            self._turns = R @ astray @ R.T @ self._turns
        self._swing()
        self._turned.append(self._turns.copy())
        if intended is not None:
            self._grippers = intended.grippers  # once the script is over they stay as they are
        hands = [HandControls(engaged=not hands_off, grip=float(grip)) for grip in self._grippers]
        walk = np.zeros(3) if intended is None else _sticks(intended.velocity)
        self._held.append(Controls(left=hands[0], right=hands[1], lean=False, walk=walk))

    def messages(self, begin_s: float) -> Iterator[tuple[float, protocol.Input]]:
        """Yield times and messages of the step of 0.1 s that ``move`` was called for last.

        Args:
            begin_s: When the step begins, from the first one on [s].
        """
        first = math.ceil(begin_s * HEADSET_HZ - 1e-9)
        last = math.ceil((begin_s + STEP_DT) * HEADSET_HZ - 1e-9)
        for number in range(first, last):
            time_s = number / HEADSET_HZ
            made_s = max(0.0, time_s - self._person.delay_s)
            controls = self._held[min(math.ceil(made_s / STEP_DT), len(self._held) - 1)]
            hands = [
                replace(hand, pose=None if self._lost[index] > 0 else self._device(index, made_s))
                for index, hand in enumerate(controls.hands)
            ]
            head = poses.from_rotation(self._R_room_heading, np.array([0.0, 0.0, 1.6]))
            yield (
                time_s,
                protocol.Input(
                    controls=replace(controls, left=hands[0], right=hands[1], head=head),
                    sequence=number,
                    sent_s=0.0,
                    device="headset",
                ),
            )

    def _device(self, index: int, time_s: float) -> np.ndarray:
        """Return the pose (4, 4) of a hand's device in the room, with its tremor."""
        fine = time_s / STEP_DT * FINE
        low = min(int(fine), len(self._ways) - 1)
        high = min(low + 1, len(self._ways) - 1)
        position = self._ways[low][index] + (fine - int(fine)) * (self._ways[high] - self._ways[low])[index]
        step = min(int(time_s / STEP_DT), len(self._turned) - 1)
        after = min(step + 1, len(self._turned) - 1)
        ends = [poses.from_rotation(self._turned[at][index], np.zeros(3)) for at in (step, after)]
        turn = poses.interpolate(ends[0], ends[1], np.array(time_s / STEP_DT - int(time_s / STEP_DT)))[:3, :3]
        shake, twist = self._tremors[index]
        return poses.from_rotation(poses.rotation_from_vector(twist.at(time_s)) @ turn, position + shake.at(time_s))

    def _advance(self, view: SceneView, targets: np.ndarray, missed: np.ndarray) -> None:
        """Go on with the script, unless the person pauses, has let go, or waits for a target."""
        person, tick = self._person, self._script_tick
        self._lost = np.maximum(self._lost - 1, 0)
        if self._released > 0:
            self._released -= 1
            return
        if self._waiting > 0:
            self._waiting -= 1
            return
        if np.abs(missed).max(initial=0.0) > WAITING_M or self._lost.any():
            return
        self._intended = self._script.poses(replace(view, T_world_targets=targets))
        if self._intended is None:
            self.over = True
            return
        self._script_tick += 1
        self._waiting = max([ticks for at, ticks in person.pauses if at == tick], default=0)
        self._released = max([ticks for at, ticks in person.regrips if at == tick], default=0)
        if self._released:
            self._aims = self._aims + self._rng.uniform(-0.12, 0.12, self._aims.shape)
            turns = poses.rotation_from_vector(self._rng.uniform(-0.3, 0.3, self._aims.shape))
            self._turns = turns @ self._turns
        for at, ticks, hand in person.losses:
            if at == tick:
                self._lost[hand] = ticks

    def _swing(self) -> None:
        """Move the hands after where they are meant to be, as springs."""
        person, dt = self._person, STEP_DT / FINE
        for _ in range(FINE):
            pull = person.frequency**2 * (self._aims - self._hands)
            self._speeds = self._speeds + dt * (pull - 2.0 * person.damping * person.frequency * self._speeds)
            self._hands = self._hands + dt * self._speeds
            self._ways.append(self._hands.copy())


def _sticks(velocity: np.ndarray) -> np.ndarray:
    """Return how far sticks are pushed (3,) to walk with a velocity."""
    reach = [-low if v < 0 else high for v, (low, high) in zip(velocity, WALK_SPEED, strict=True)]
    share = np.clip(velocity / np.array(reach), -1.0, 1.0)
    return np.where(share == 0.0, 0.0, np.sign(share) * (DEAD_ZONE + (1.0 - DEAD_ZONE) * np.abs(share)))


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A perturbed operator's demonstration.

    Attributes:
        demonstration: As it was saved.
        person: Who gave it.
        tries: Recordings that it took.
        refusals: Why those before it were not saved.
    """

    demonstration: Demonstration
    person: Person
    tries: int
    refusals: tuple[str, ...]


def record_perturbed(
    task: Task, seed: int, root: Path, judge: Callable[[Demonstration], str] = lambda _: ""
) -> Recorded:
    """Record a task as a person would, who begins anew where a recording did not succeed, or its trial was bad.

    Args:
        task: The task; it has a script.
        seed: Of the person.
        root: Where the demonstration goes; must not exist.
        judge: Given a recording that succeeded; returns why the person tries again, or nothing.

    Raises:
        DemonstrationError: No recording of several succeeded.
    """
    script = script_of(task)
    settings = SessionSettings(operator=f"perturbed: {task.slug} {seed}", trial=None)
    session = RecordingSession(task, root, script.start, settings=settings)
    person, refusals = draw_person(np.random.default_rng([STREAM, seed])), []
    try:
        for number in range(MAX_TRIES):
            rng = np.random.default_rng([STREAM, seed, 1 + number])
            _perform(session, PerturbedOperator(script.make_operator(), person, rng))
            verdict = session.status().verdict
            assert verdict is not None  # it is in review
            why = verdict.refusal if session.recorded is None else judge(session.recorded)
            if not why:
                session.press("save")
                saved = demonstrations.load(root, task)
                return Recorded(demonstration=saved, person=person, tries=number + 1, refusals=tuple(refusals))
            refusals.append(why)
            session.press("discard")
            again = draw_person(np.random.default_rng([STREAM, seed, 0, number]))  # troubles at other times
            person = replace(person, pauses=again.pauses, regrips=again.regrips, losses=again.losses)
    finally:
        session.close()
        session.journal.remove()
    got = f"{MAX_TRIES} recordings of {task.name} in vain, the last one with {refusals[-1]}"
    raise DemonstrationError(got, "a good one", "see why they fail")


def _perform(session: RecordingSession, operator: PerturbedOperator) -> None:
    """Record once; ends in review."""
    now = [0.0]
    inputs = Inputs(lambda: now[0])
    session.press("record")
    waited = step = 0
    while session.state != REVIEW:
        operator.move(session.view(), session.targets)
        begin_s = step * STEP_DT
        for time_s, message in operator.messages(begin_s):
            now[0] = time_s
            inputs.put(operator, message)
        now[0] = begin_s + STEP_DT
        session.advance(inputs.latest())
        step += 1
        waited += operator.over
        held = operator.over and session.held_s >= HOLD_S
        if held or waited > AT_END_TICKS or session.paused or step >= MAX_TICKS:
            if session.state != REVIEW:
                session.press("record")

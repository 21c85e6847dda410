"""What a session tells its operator: the state it is in, and what is known of a recording before it is saved."""

from dataclasses import dataclass

from lerobot_demohlm.teleop.trial import TrialReport

IDLE, ENGAGED, RECORDING, REVIEW, SAVED = "idle", "engaged", "recording", "review", "saved"


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
        grippers: What is asked of the left and the right gripper, 0 open .. 1 closed.
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
    grippers: tuple[float, float]
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

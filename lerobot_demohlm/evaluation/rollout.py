"""One rollout of a policy as a record: the line that ``demohlm evaluate`` writes and that reports and tables read."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from gym_demohlm.simulation.judge import OUTCOMES


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """One evaluated episode.

    Attributes:
        task: Name of the task.
        policy: Type of the policy as LeRobot registers it, such as "chunked_mlp".
        policy_hash: SHA-256 of everything that decides the policy's actions.
        num_train_episodes: Episodes that the policy was trained on; None where that is unknown.
        train_seed: Seed of the policy's training; None where that is unknown.
        region: Initial region.
        seed: Seed of the start.
        success_ever: Whether the success condition was true at some step.
        success_end: Whether the success condition was true at the last step.
        success_held: Whether the success condition was true throughout one second.
        success_strict: Whether it was held, nothing had gone wrong before, and the robot stood for 2 s after it; None
            in files of versions that did not judge it.
        outcome: How the episode ended, one of ``OUTCOMES``.
        length_s: Simulated time [s].
        clipped: Numbers in commands that were outside their bounds.
        perception: How objects were seen, see ``gym_demohlm.perception.settings``.
        perception_faults: How often what went wrong with a pose server, by its reason.
        initial_state: Where the episode began: "robot" (x [m], y [m], yaw [rad]) in the world, "object" (y [m],
            z [m], yaw [rad]) as differences from the task's layout, and the conditions of its world.
        variation: How worlds differed.
        controller: SHA-256 of the whole-body controller's weights; empty in files of versions that did not note it.
        code: SHA-256 of the code of the simulation, and of the task's file where that is outside of the package; empty
            in files of versions that did not note it.
    """

    task: str
    policy: str
    policy_hash: str
    num_train_episodes: int | None = None
    train_seed: int | None = None
    region: str
    seed: int
    success_ever: bool
    success_end: bool
    success_held: bool
    outcome: str
    length_s: float
    clipped: int = 0
    perception: str = "exact"
    perception_faults: Mapping[str, int] = field(default_factory=dict)
    initial_state: Mapping[str, list[float]]
    variation: str = "none"
    success_strict: bool | None = None
    controller: str = ""
    code: str = ""

    @property
    def succeeded(self) -> bool:
        """Whether it succeeded strictly, or was held where that was not judged."""
        return self.success_held if self.success_strict is None else self.success_strict

    def __post_init__(self) -> None:
        """Check the outcome."""
        if self.outcome not in OUTCOMES:
            raise ValueError(f"got outcome {self.outcome!r}; expected one of {', '.join(OUTCOMES)}; correct it")

"""The table of all that may vary: each factor with its ranges, its unit, and where the ranges come from.

docs/variation.md is made from this table, and so are the draws of an episode. A factor is neutral at one value, where
it changes nothing; the strength of a variation moves its ranges towards that value.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Literal

from gym_demohlm.errors import SceneError
from gym_demohlm.robot import g1

Range = tuple[float, float]
Group = Literal["objects", "robot", "start", "pushes", "scene", "perception"]
GROUPS: tuple[Group, ...] = ("objects", "robot", "start", "pushes", "scene", "perception")

LIMBS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "left_leg": tuple(name for name in g1.LEG_JOINTS if name.startswith("left")),
        "right_leg": tuple(name for name in g1.LEG_JOINTS if name.startswith("right")),
        "waist": g1.WAIST_JOINTS,
        "left_arm": tuple(name for name in g1.ARM_JOINTS if name.startswith("left")),
        "right_arm": tuple(name for name in g1.ARM_JOINTS if name.startswith("right")),
    }
)
"""Joints of each limb, as in ``g1.BODY_JOINTS``."""
CLUTTER = ("clutter_0", "clutter_1")
"""Bodies of the things beside a task's objects."""
MOST_PUSHES = 16  # in an episode

_MJLAB = "mjlab 1.6 `tasks/velocity/velocity_env_cfg.py`"
_UNITREE = "unitree_rl_lab `robots/g1/29dof/velocity_env_cfg.py`"
_CHOSEN = "chosen"


@dataclass(frozen=True, kw_only=True)
class Factor:
    """One thing that varies.

    Attributes:
        group: The group that switches it.
        name: Of the factor; unique in its group.
        unit: Of its numbers; "1" for a ratio.
        each: What has numbers of its own: the "episode", each loose "object", each "limb", or each thing of "clutter".
        size: How many numbers each has.
        neutral: The value that changes nothing; None where the strength leaves the range alone.
        real: Range of the preset ``real``.
        hard: Range of the preset ``hard``.
        bounds: What a range must lie in: beyond it the model means nothing.
        meaning: What the numbers do.
        source: Where the ranges come from.
    """

    group: Group
    name: str
    unit: str
    each: Literal["episode", "object", "limb", "clutter"] = "episode"
    size: int = 1
    neutral: float | None
    real: Range
    hard: Range
    bounds: Range
    meaning: str
    source: str

    @property
    def key(self) -> str:
        """Its name among all factors, ``objects.mass``."""
        return f"{self.group}.{self.name}"

    def check(self, range_: Range) -> None:
        """Raise SceneError where a range is empty or leaves the bounds."""
        low, high = range_
        if not (self.bounds[0] <= low <= high <= self.bounds[1]):
            raise SceneError(
                f"{self.key} from {low:g} to {high:g}",
                f"a range within {self.bounds[0]:g} to {self.bounds[1]:g} [{self.unit}], the lower end first",
                "correct the range",
            )

    def scaled(self, range_: Range, strength: float) -> Range:
        """Return a range moved towards the neutral value: strength 0 changes nothing, 1 leaves the range."""
        if self.neutral is None:
            return range_
        low, high = (self.neutral + strength * (end - self.neutral) for end in range_)
        return max(low, self.bounds[0]), min(high, self.bounds[1])


_ALL = (
    Factor(
        group="objects", name="size", unit="1", each="object", neutral=1.0, real=(0.93, 1.07), hard=(0.85, 1.15),
        bounds=(0.5, 1.4), meaning="size of a loose object over its own; vessels that hold something keep theirs",
        source=_CHOSEN,
    ),
    Factor(
        group="objects", name="mass", unit="1", each="object", neutral=1.0, real=(0.7, 1.5), hard=(0.5, 2.0),
        bounds=(0.1, 10.0), meaning="mass of a loose object over its own", source=_CHOSEN,
    ),
    Factor(
        group="objects", name="com", unit="half sizes", each="object", size=3, neutral=0.0, real=(-0.15, 0.15),
        hard=(-0.3, 0.3), bounds=(-0.8, 0.8), meaning="shift of a loose object's centre of mass along its axes",
        source=_CHOSEN,
    ),
    Factor(
        group="objects", name="friction", unit="1", neutral=1.0, real=(0.6, 1.2), hard=(0.4, 1.4), bounds=(0.05, 5.0),
        meaning="sliding friction of objects, furniture, palms and pads over their own, all by one ratio: in a contact "
        "the larger one counts",
        source=_CHOSEN,
    ),
    Factor(
        group="objects", name="hinge", unit="1", neutral=1.0, real=(0.5, 2.0), hard=(0.3, 3.0), bounds=(0.0, 20.0),
        meaning="damping and dry friction of hinges, wheels and casters over their own", source=_CHOSEN,
    ),
    Factor(
        group="robot", name="strength", unit="1", each="limb", neutral=1.0, real=(0.9, 1.0), hard=(0.8, 1.0),
        bounds=(0.2, 2.0), meaning="largest torque of a limb's motors over their own",
        source="unitree_rl_lab `unitree_actuators.py`: the peak torque of a turning motor is 0.8 of the rated one",
    ),
    Factor(
        group="robot", name="gain", unit="1", each="limb", neutral=1.0, real=(0.9, 1.1), hard=(0.8, 1.2),
        bounds=(0.3, 3.0), meaning="stiffness and damping of a limb's servos over their own", source=_CHOSEN,
    ),
    Factor(
        group="robot", name="dry_friction", unit="1", neutral=0.0, real=(0.0, 1.0), hard=(0.5, 1.5), bounds=(0.0, 5.0),
        meaning="dry friction of the joints of legs and waist over that of `g1.Motor`",
        source="unitree_rl_lab `unitree_actuators.py`, Fs",
    ),
    Factor(
        group="robot", name="link_mass", unit="1", each="limb", neutral=1.0, real=(0.95, 1.05), hard=(0.9, 1.1),
        bounds=(0.3, 3.0), meaning="mass of a limb's links over their own", source=_CHOSEN,
    ),
    Factor(
        group="robot", name="payload", unit="kg", neutral=0.0, real=(-0.5, 1.5), hard=(-1.0, 3.0), bounds=(-3.0, 8.0),
        meaning="what the torso carries", source=f"{_UNITREE}, `add_base_mass`; `real` is half of it",
    ),
    Factor(
        group="robot", name="torso_com", unit="m", size=3, neutral=0.0, real=(-0.015, 0.015), hard=(-0.025, 0.025),
        bounds=(-0.1, 0.1), meaning="shift of the torso's centre of mass", source=f"{_MJLAB}, `base_com`",
    ),
    Factor(
        group="robot", name="delay", unit="s", neutral=0.0, real=(0.0, 0.010), hard=(0.0, 0.020), bounds=(0.0, 0.020),
        meaning="time by which the servos get their targets late, in whole steps of 2 ms",
        source=f"{_CHOSEN}: at most one tick of the controller",
    ),
    Factor(
        group="robot", name="encoder_bias", unit="rad", neutral=0.0, real=(0.0, 0.008), hard=(0.008, 0.015),
        bounds=(0.0, 0.2), meaning="each joint reads wrong by up to this, throughout the episode",
        source=f"{_MJLAB}, `encoder_bias`",
    ),
    Factor(
        group="robot", name="encoder", unit="rad", neutral=0.0, real=(0.0, 0.005), hard=(0.002, 0.010),
        bounds=(0.0, 0.2), meaning="noise of each joint's position, uniform up to this",
        source=f"{_UNITREE}, noise of `joint_pos_rel`",
    ),
    Factor(
        group="robot", name="speed", unit="rad/s", neutral=0.0, real=(0.0, 0.5), hard=(0.3, 1.5), bounds=(0.0, 10.0),
        meaning="noise of each joint's velocity, uniform up to this",
        source=f"{_UNITREE}, noise of `joint_vel_rel`",
    ),
    Factor(
        group="robot", name="gyro", unit="rad/s", neutral=0.0, real=(0.0, 0.1), hard=(0.05, 0.2), bounds=(0.0, 5.0),
        meaning="noise of each axis of the gyroscope, uniform up to this",
        source=f"{_UNITREE}, noise of `base_ang_vel`",
    ),
    Factor(
        group="robot", name="gravity", unit="rad", neutral=0.0, real=(0.0, 0.02), hard=(0.01, 0.05), bounds=(0.0, 0.5),
        meaning="noise of the measured roll and pitch, uniform up to this",
        source=f"{_UNITREE}, noise of `projected_gravity`",
    ),
    Factor(
        group="start", name="arms", unit="rad", size=len(g1.ARM_JOINTS), neutral=0.0, real=(-0.1, 0.1),
        hard=(-0.2, 0.2), bounds=(-0.6, 0.6),
        meaning="posture of the arms against the robot's rest; the shoulders roll outwards, away from the thighs",
        source=_CHOSEN,
    ),
    Factor(
        group="start", name="waist", unit="rad", neutral=0.0, real=(-0.1, 0.1), hard=(-0.2, 0.2), bounds=(-0.5, 0.5),
        meaning="turn of the waist against the robot's rest", source=_CHOSEN,
    ),
    Factor(
        group="pushes", name="pause", unit="s", size=MOST_PUSHES, neutral=None, real=(4.0, 8.0), hard=(3.0, 6.0),
        bounds=(0.02, 1000.0), meaning="time between pushes, and before the first",
        source=f"{_UNITREE}, `push_robot`: every 5 s",
    ),
    Factor(
        group="pushes", name="velocity", unit="m/s", size=2 * MOST_PUSHES, neutral=0.0, real=(-0.2, 0.2),
        hard=(-0.5, 0.5), bounds=(-2.0, 2.0), meaning="change of the pelvis's velocity in a push, along x and y",
        source=f"{_UNITREE}, `push_robot`: 0.5 m/s, to train a controller alone; `real` is less than half of it",
    ),
    Factor(
        group="scene", name="floor", unit="1", neutral=0.8, real=(0.5, 1.0), hard=(0.3, 1.0), bounds=(0.05, 3.0),
        meaning="sliding friction of soles on the floor", source=f"{_UNITREE}, `physics_material`",
    ),
    Factor(
        group="scene", name="table_width", unit="1", neutral=1.0, real=(1.0, 1.15), hard=(1.0, 1.4), bounds=(0.8, 2.0),
        meaning="width of tables, their legs and feet over their own", source=_CHOSEN,
    ),
    Factor(
        group="scene", name="height", unit="m", neutral=0.0, real=(-0.03, 0.03), hard=(-0.06, 0.06),
        bounds=(-0.2, 0.2), meaning="height of objects and tables, beside the region's; cut where the region ends",
        source=_CHOSEN,
    ),
    Factor(
        group="scene", name="clutter", unit="1", each="clutter", size=3, neutral=None, real=(0.3, 1.0), hard=(0.0, 1.0),
        bounds=(0.0, 1.0), meaning="nearness, direction and size of a can on the table, behind the objects; 0 is the "
        "nearest, the straightest and the smallest",
        source=_CHOSEN,
    ),
    Factor(
        group="perception", name="errors", unit="1", neutral=0.0, real=(0.5, 1.5), hard=(1.0, 3.0), bounds=(0.0, 10.0),
        meaning="factor of the errors that are fitted to the tracker, where a task has such a fit; with 0 poses are "
        "exact and objects are never lost",
        source="`demohlm fit-perception`; the spread is chosen",
    ),
    Factor(
        group="perception", name="bias", unit="mm", neutral=0.0, real=(0.0, 3.0), hard=(0.0, 8.0), bounds=(0.0, 100.0),
        meaning="length of an error of each object's place, in a random direction, with an error of its turn of 0.2 "
        "degrees a millimetre; both stay for the whole episode: a camera or a mesh that is a little off",
        source=f"{_CHOSEN}: what is left of a camera's calibration",
    ),
    Factor(
        group="perception", name="latency", unit="s", neutral=0.0, real=(0.0, 0.1), hard=(0.0, 0.3), bounds=(0.0, 5.0),
        meaning="age of poses, in whole steps of 0.1 s", source="FoundationPose's users: 5 to 10 poses a second",
    ),
    Factor(
        group="perception", name="dropout", unit="1", neutral=0.0, real=(0.0, 0.05), hard=(0.0, 0.2), bounds=(0.0, 1.0),
        meaning="share of frames that give no new pose", source=_CHOSEN,
    ),
)  # fmt: skip

FACTORS: Mapping[str, Factor] = MappingProxyType({factor.key: factor for factor in _ALL})
"""Every factor by its key, in the order of the documentation."""


def _check() -> None:
    for factor in _ALL:
        factor.check(factor.real)
        factor.check(factor.hard)
        numbers = [value for entry in fields(factor) if isinstance(value := getattr(factor, entry.name), float)]
        assert all(map(math.isfinite, numbers))


_check()

"""A task as data (``Task``), the paper's initial regions (``Region``), and the registry of the files in ``tasks/``.

A task file holds one ``TASK`` value: what it adds to the robot's world, which objects are tracked, and when it has
succeeded. The environment owns the loop. A new task is one new file in ``tasks/``, or one call of ``register_task``
outside this package (``docs/adding_a_task.md``).
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

import mujoco
import numpy as np

from gym_demohlm.errors import SceneError, UnknownNameError

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

InitialState = dict[str, list[float]]
"""Where an episode starts: ``{"robot": [x, y, yaw], "object": [dy, dz, dyaw]}`` [m, rad], world frame.

``robot`` is the pelvis on the floor plane; ``object`` is added to the default pose of each placed object. There may be
more keys: "object_x" [dx], added likewise; the name of an object with a ``Spread``, [dx, dy, dyaw] of its own; and
conditions of the world, whose names have a dot (``gym_demohlm.variation``).
"""

Predicate = Callable[["Worlds"], np.ndarray]
"""A question about all worlds at once: simulation -> (num_worlds,) bool."""

MotionFrame = Literal["robot", "hands", "scene"]

Range = tuple[float, float]
Lengths = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Region:
    """Ranges from which an initial state is drawn uniformly (paper, appendix "Initial Regions").

    Attributes:
        name: R1, R2, R3 or R4.
        robot_x: Pelvis x [m].
        robot_y: Pelvis y [m].
        robot_yaw: Pelvis heading [rad].
        object_y: Offset of the object and its support from their default y [m].
        object_z: Offset of the object and its support from their default z [m].
        object_yaw: Offset from the object's default yaw [rad].
    """

    name: str
    robot_x: Range
    robot_y: Range
    robot_yaw: Range
    object_y: Range
    object_z: Range
    object_yaw: Range

    def __post_init__(self) -> None:
        for entry in fields(self)[1:]:
            low, high = getattr(self, entry.name)
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                raise SceneError(f"{entry.name}=({low}, {high})", "a finite (low, high) with low <= high", "swap them")

    def sample(self, rng: np.random.Generator) -> InitialState:
        """Draw one initial state; always six draws, in the order of the attributes."""
        x, y, yaw, dy, dz, dyaw = (float(rng.uniform(*getattr(self, entry.name))) for entry in fields(self)[1:])
        return {"robot": [x, y, yaw], "object": [dy, dz, dyaw]}

    def widened(self, factor: float) -> "Region":
        """Return the region with wider ranges of the robot's pose, x only away from the objects, whose ranges stay.

        Args:
            factor: Factor of the ranges' lengths; 1 returns the region itself.
        """
        if factor == 1.0:
            return self

        def both_ways(range_: Range) -> Range:
            middle, half = (range_[0] + range_[1]) / 2.0, factor * (range_[1] - range_[0]) / 2.0
            return middle - half, middle + half

        nearest = self.robot_x[1]
        return replace(
            self,
            robot_x=(nearest - factor * (nearest - self.robot_x[0]), nearest),
            robot_y=both_ways(self.robot_y),
            robot_yaw=both_ways(self.robot_yaw),
        )


@dataclass(frozen=True, kw_only=True)
class WideRegion(Region):
    """A region that also moves objects to and from the robot.

    Attributes:
        object_x: Offset of the object and its support from their default x [m].
    """

    object_x: Range

    def sample(self, rng: np.random.Generator) -> InitialState:
        """Draw one initial state with one more key, "object_x"; seven draws."""
        x, y, yaw, dy, dz, dyaw, dx = (float(rng.uniform(*getattr(self, entry.name))) for entry in fields(self)[1:])
        return {"robot": [x, y, yaw], "object": [dy, dz, dyaw], "object_x": [dx]}


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Ranges in which one object is moved by itself, beside what a region moves together.

    Attributes:
        x: Along the world's x axis [m].
        y: Along the world's y axis [m].
        yaw: About the vertical [rad].
        everywhere: Whether it is moved in every region; else in R4 alone, and the paper's regions move all as one.
    """

    x: Range
    y: Range
    yaw: Range = (0.0, 0.0)
    everywhere: bool = False

    def sample(self, rng: np.random.Generator) -> list[float]:
        """Draw [dx, dy, dyaw] [m, m, rad]; three draws."""
        return [float(rng.uniform(*range_)) for range_ in (self.x, self.y, self.yaw)]


def _region(name: str, xs: Range, y: float, yaw: float, dy: float, dz: float, dyaw: float) -> Region:
    return Region(
        name=name,
        robot_x=xs,
        robot_y=(-y, y),
        robot_yaw=(-yaw, yaw),
        object_y=(0.0, dy),
        object_z=(-dz, 0.0),
        object_yaw=(-dyaw, dyaw),
    )


REGIONS: Mapping[str, Region] = MappingProxyType(
    {
        "R1": _region("R1", (-0.6, -0.3), 0.05, math.pi / 16, 0.02, 0.05, math.pi / 4),
        "R2": _region("R2", (-1.0, -0.3), 0.1, math.pi / 8, 0.05, 0.1, math.pi / 2),
        "R3": _region("R3", (-1.2, -0.3), 0.3, math.pi / 4, 0.1, 0.2, math.pi),
    }
)
DEFAULT_REGION = "R3"
WIDEST = "R4"
"""A region of every task beside those of the paper: three times as wide, and further ahead."""
SCORING_SEEDS = range(3_000_000, 2**31)
"""Seeds of starts that score: nothing is tuned on them, and no preset, test or default uses them."""


def dropped(name: str, depth_m: float) -> Predicate:
    """Return the predicate "this object is more than ``depth_m`` [m] below its start"."""
    return lambda sim: sim.pose(name)[:, 2, 3] < sim.start_pose(name)[:, 2, 3] - depth_m


def limit_yaw(regions: Mapping[str, Region], object_yaw: float) -> dict[str, Region]:
    """Return the regions with the object's yaw limited to +-object_yaw [rad], for things with a front."""

    def limited(region: Region) -> Region:
        low, high = region.object_yaw
        return replace(region, object_yaw=(max(low, -object_yaw), min(high, object_yaw)))

    return {name: limited(region) for name, region in regions.items()}


@dataclass(frozen=True, kw_only=True)
class ObjectSpec:
    """One tracked object of a task: a body with a free joint, or a mocap body that carries something articulated.

    A part of another object, such as the door of a cabinet, has neither: it is ``placed=False`` and moves with its
    parent.

    Attributes:
        name: Name of its body.
        position: Default position of the body's origin in the world [m].
        yaw: Default heading [rad].
        symmetry: Turns about the body's z axis [rad] after which the object looks the same, including 0; ``"any"`` for
            a round object. The default, ``(0.0,)``, is for an object without symmetry.
        placed: Whether a region moves the object; otherwise it always starts at its default pose.
        moves_with: Name of the object that this one lies on or hangs in. It then starts as if both were one body, and
            ``placed`` has no effect.
        height_joint: Slide joint that takes the region's z offset instead of the body, for a thing that stands on the
            floor and can be made taller or lower.
        resized: Lengths along its axes in demonstrations and here [m], where a box is not as demonstrated.
    """

    name: str
    position: tuple[float, float, float]
    yaw: float = 0.0
    symmetry: tuple[float, ...] | Literal["any"] = (0.0,)
    placed: bool = True
    moves_with: str | None = None
    height_joint: str | None = None
    resized: tuple[Lengths, Lengths] | None = None

    def __post_init__(self) -> None:
        if self.symmetry != "any" and 0.0 not in self.symmetry:
            raise SceneError(f"symmetry {self.symmetry} of {self.name!r}", "angles with 0.0 among them", "add 0.0")


@dataclass(frozen=True, kw_only=True)
class WideForm:
    """What a task has in R4 instead of things with four equal sides, so that their yaw counts.

    Attributes:
        build: Function that adds the task's bodies, as that of the task.
        objects: Tracked objects, by the names and in the order of the task's.
    """

    build: Callable[[mujoco.MjSpec], None]
    objects: tuple[ObjectSpec, ...]


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Where something is brought to.

    Attributes:
        object: Name of the object on which, in which or beside which it ends.
        any_yaw: Whether that object's heading is of no account, as when a cube is set on another.
    """

    object: str
    any_yaw: bool = False


@dataclass(frozen=True, kw_only=True)
class Memory:
    """What a world remembers in addition to its physics, such as which parts of a board have been wiped.

    Attributes:
        size: Number of values; all are 0 after a reset.
        update: Function called after every step: worlds, their memory (N, size) -> the new memory (N, size).
        draw: Function that shows the memory (size,) of one world in the model, just before that world is drawn.
    """

    size: int
    update: Callable[["Worlds", np.ndarray], np.ndarray]
    draw: Callable[[mujoco.MjModel, np.ndarray], None] = lambda _model, _memory: None


@dataclass(frozen=True, kw_only=True)
class Task:
    """What distinguishes one task from another.

    Attributes:
        name: CamelCase; the Gymnasium id is ``DemoHLM/<name>-v0``.
        description: The instruction in words, for a language-conditioned policy.
        hands: Kind of both hands.
        build: Function that adds the task's bodies to the robot's spec, which already has floor, light and camera.
        objects: Tracked objects, in the order of ``environment_state``.
        success: The paper's success condition.
        gaze_target: Name of the object that the neck keeps in view.
        searched: Other objects, which may be out of view: the neck looks around until it has seen each of them once.
        supports: Mocap bodies of the furniture under objects, the first one under the placed objects; they move with
            the region's y and z offsets. One that is itself among the objects is placed as such.
        obstacles: Bodies that the robot should not touch; contacts with them are reported as collisions.
        contact_pairs: ``(side, object)`` pairs whose normal force is measured, side "left" or "right" hand.
        force_pairs: Pairs of other bodies whose normal force is measured, such as a tool and what it works on.
        failures: Predicates that end an attempt, by the name of what went wrong, such as "dropped".
        regions: Initial regions by name. R4 is made from R3's yaw, see ``region``.
        highest_z: Largest offset in z of R4 [m], where something cannot be lifted so far.
        wide_form: What is otherwise in R4; None where all is as in the other regions.
        spreads: Objects that are moved by themselves, each on the same support as without it, by name.
        goals: Objects that are brought to another one, by name; the motion that brings them there is about the latter.
        episode_length_s: Time limit [s].
        motion_frame: What the motion after a touch is relative to: "robot" for a motion that ends at the body, such as
            a lift; "hands" for one that ends where the hands touched, such as pressing something down; "scene" for one
            that is fixed by things in the world, such as the arc of a door.
        riders: Bodies with free joints that start in or on an object and are placed with it, by that object's name.
        memory: What a world remembers in addition to its physics; None for nothing.
    """

    name: str
    description: str
    hands: Literal["rubber", "gripper"]
    build: Callable[[mujoco.MjSpec], None]
    objects: tuple[ObjectSpec, ...]
    success: Predicate
    gaze_target: str
    searched: tuple[str, ...] = ()
    supports: tuple[str, ...] = ()
    obstacles: tuple[str, ...] = ()
    contact_pairs: tuple[tuple[str, str], ...] = ()
    force_pairs: tuple[tuple[str, str], ...] = ()
    failures: Mapping[str, Predicate] = field(default_factory=dict)
    regions: Mapping[str, Region] = REGIONS
    highest_z: float = 0.2
    wide_form: WideForm | None = None
    spreads: Mapping[str, Spread] = field(default_factory=dict)
    goals: Mapping[str, Goal] = field(default_factory=dict)
    episode_length_s: float = 30.0
    motion_frame: MotionFrame = "robot"
    riders: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    memory: Memory | None = None

    @property
    def slug(self) -> str:
        """The name as files and datasets have it: ``LiftBox`` -> ``lift_box``."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", self.name).lower()

    @property
    def module(self) -> str:
        """The module that defines the task, where its ``build`` is: a process that imports it knows the task."""
        return self.build.__module__

    def __post_init__(self) -> None:
        names = [spec.name for spec in self.objects]
        if len(set(names)) != len(names) or not names:
            raise SceneError(f"objects {names} in task {self.name}", "one or more, each name once", "rename one")
        carriers = [entry.moves_with for entry in self.objects if entry.moves_with is not None]
        for name in (
            self.gaze_target,
            *self.searched,
            *(name for _, name in self.contact_pairs),
            *carriers,
            *self.riders,
            *self.spreads,
            *self.goals,
            *(goal.object for goal in self.goals.values()),
        ):
            self.object(name)
        for side, _ in self.contact_pairs:
            if side not in ("left", "right"):
                raise UnknownNameError("hand", side, ("left", "right"))
        if not self.episode_length_s > 0:
            raise SceneError(f"episode_length_s={self.episode_length_s}", "more than 0 s", "set a time limit")

    @property
    def form(self) -> str:
        """The only region that it has, "R4", where it is the wide form, see ``at``; else empty."""
        return WIDEST if tuple(self.regions) == (WIDEST,) else ""

    def at(self, region: str) -> "Task":
        """Return the task as a region has it: itself, or its wide form, which has R4 alone.

        Raises:
            UnknownNameError: The task has no such region.
            SceneError: Its wide form has other objects.
        """
        found = self.region(region)
        if region != WIDEST or self.wide_form is None:
            return self
        form = self.wide_form
        got, expected = ([entry.name for entry in entries] for entries in (form.objects, self.objects))
        if got != expected:
            raise SceneError(f"objects {got} in the wide form of {self.name}", f"{expected}", "name them alike")
        return replace(self, build=form.build, objects=form.objects, regions={WIDEST: found}, wide_form=None)

    def turns_away(self, region: str) -> bool:
        """Tell whether the first object may face away from the robot by more than 45 degrees, in a region [rad].

        In the paper's regions none does: things turn no further, or look the same after a quarter turn.
        """
        symmetry, yaws = self.objects[0].symmetry, self.region(region).object_yaw
        return symmetry != "any" and min(max(map(abs, yaws)), math.pi / len(symmetry)) > math.pi / 4 + 1e-9

    def is_scattered(self, region: str) -> bool:
        """Tell whether objects start in a region each by itself, so that no motion can be about one of them alone."""
        return any(own.everywhere or region == WIDEST for own in self.spreads.values())

    def object(self, name: str) -> ObjectSpec:
        """Return the tracked object of that name."""
        for spec in self.objects:
            if spec.name == name:
                return spec
        raise UnknownNameError("object", name, [spec.name for spec in self.objects])

    def region(self, name: str) -> Region:
        """Return the initial region of that name.

        R4 has the robot at x from -2 to -0.3 m, up to 0.8 m aside and turned by up to 90 degrees, and objects up to
        0.1 m nearer or further, 0.15 m aside and 0.2 m lower or higher, with the yaw of R3.
        """
        if name == WIDEST and name not in self.regions and DEFAULT_REGION in self.regions:
            return WideRegion(
                name=WIDEST,
                robot_x=(-2.0, -0.3),
                robot_y=(-0.8, 0.8),
                robot_yaw=(-math.pi / 2, math.pi / 2),
                object_y=(-0.15, 0.15),
                object_z=(-0.2, self.highest_z),
                object_yaw=self.regions[DEFAULT_REGION].object_yaw,
                object_x=(-0.1, 0.1),
            )
        if name not in self.regions:
            raise UnknownNameError("region", name, {*self.regions, WIDEST})
        return self.regions[name]

    def sample(self, region: str, rng: np.random.Generator, spread: float = 1.0) -> InitialState:
        """Draw an initial state from a region.

        Args:
            region: Name of the region.
            rng: Source of the randomness.
            spread: Factor by which the ranges of the robot's pose are widened.

        Raises:
            UnknownNameError: The task has no such region.
        """
        state = self.region(region).widened(spread).sample(rng)
        for name, own in self.spreads.items():
            if own.everywhere or region == WIDEST:
                state[name] = own.sample(rng)
        return state

    def default_state(self) -> InitialState:
        """Return a state without randomness: robot at the near edge of the regions, objects at their default poses."""
        return {"robot": [-0.3, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}

"""The code as it is -> digests of what it computes: equal on every processor, and changed by whatever changes results.

``parts`` digests poses and walks along them, the controller, inverse kinematics, the physics and one whole attempt,
each on its own, so that a difference names where it comes from. ``behaviour`` digests what generation does with a task:
the stamp of results. The digests that this version of the code has are in ``digests.json``, with the versions of the
libraries.
"""

import functools
import hashlib
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import DEFAULT_REGION, WIDEST, Task
from gym_demohlm.variation import get_variation
from lerobot_demohlm.datasets.variation import PLAIN, DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.generation.attempt import GENERATION_STREAM, Attempts
from lerobot_demohlm.generation.handing_over import handed_over
from lerobot_demohlm.generation.locomotion import LocomotionSettings, walk_velocity
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reproducibility import provenance

PACKAGED = Path(__file__).parent / "digests.json"
_POSES, _TICKS, _WORLDS, _SOLUTIONS, _STEPS = 200, 60, 5, 40, 10
_PROBE = "LiftBox"  # the task of the parts
_ATTEMPTS = 2  # of a behaviour


def parts() -> dict[str, str]:
    """Return the digest of each part of the pipeline, by name, in the order in which the parts build on each other."""
    makers: dict[str, Callable[[], Iterable[bytes]]] = {
        "poses": _poses,
        "controller": _controller,
        "inverse kinematics": _inverse_kinematics,
        "physics": _physics,
        "attempt": lambda: _attempts(get_task(_PROBE), 1),
    }
    return {name: _digest(make()) for name, make in makers.items()}


@functools.cache
def _behaviour(name: str) -> str:
    task = get_task(name)

    def content() -> Iterable[bytes]:
        rng = np.random.default_rng(0)
        for region in sorted(task.regions):
            yield repr(sorted(task.region(region).sample(rng).items())).encode()
        yield repr((task.episode_length_s, task.description)).encode()
        yield from _attempts(task, _ATTEMPTS)

    return _digest(content())


@functools.cache
def _varied(name: str, preset: str, region: str) -> str:
    """Return the digest of what attempts do in other worlds."""
    task, settings = get_task(name), Settings(variation=DataVariation(variation=preset))
    return _digest(_attempts(task, _ATTEMPTS, region, settings))


def behaviour(task: Task) -> str:
    """Return the digest of what generation does with a task: its starts, and two attempts as they are made by default.

    It sees the physics, the robot, the controller, the demonstration, the settings and the task's conditions by what
    they do; names, comments and the place of the code change nothing.
    """
    return _behaviour(task.name)


def stamp(task: Task) -> str:
    """Return eight letters that stand for a task's behaviour in results: packaged, or found where they are not."""
    known = packaged()["tasks"].get(task.name)
    return (known or behaviour(task))[:8]


def worlds_stamp(task: Task, variation: str, region: str) -> str:
    """Return what else than its ``stamp`` a result in other worlds than those of R1 to R3 without variation depends on.

    The first eight letters are ``recipe``, the others digest two attempts in such worlds. A group or a strength of a
    preset has the letters of the whole preset.

    Returns:
        16 letters; none for plain worlds of R1 to R3, where the stamp says it all.

    Raises:
        UnknownNameError: There is no such variation or region.
    """
    wide = task.region(region).name == WIDEST
    preset = re.split("[@:]", variation)[0] if get_variation(variation) else PLAIN.variation
    if preset == PLAIN.variation and not wide:
        return ""
    return recipe(preset) + _varied(task.name, preset, WIDEST if wide else DEFAULT_REGION)[:8]


@functools.cache
def recipe(preset: str) -> str:
    """Return eight letters that change with the ranges of a variation and the numbers by which attempts adapt to it."""
    ranges, numbers = sorted(get_variation(preset).ranges.items()), astuple(Settings().adaptation)
    return _digest([repr(ranges).encode(), repr(numbers).encode()])[:8]


@functools.cache
def table_recipe() -> str:
    """Return eight letters that change with the numbers by which attempts in R4 keep clear of tables."""
    return _digest([repr(astuple(Settings().tables)).encode()])[:8]


@functools.cache
def shoulder_recipe() -> str:
    """Return eight letters that change with the numbers by which hands in R4 keep clear of their shoulders."""
    playback = Settings().playback
    return _digest([repr((playback.far_up_m, playback.shoulder_m)).encode()])[:8]


@functools.cache
def handing_over_recipe() -> str:
    """Return eight letters that change with the numbers by which a hand pushes a thing onto the other's palm in R4."""
    return _digest([repr(astuple(Settings().handing_over)).encode()])[:8]


@functools.cache
def hands_over(name: str) -> bool:
    """Return whether a hand pushes a thing onto the other's palm in the packaged demonstration of a task."""
    task = get_task(name)
    demonstration = demonstrations.load(None, task)
    return handed_over(demonstration, segment(demonstration, task)) is not None


def packaged() -> dict[str, Any]:
    """Return what ``digests.json`` holds: ``versions``, ``parts`` and, by task, ``tasks``.

    Raises:
        DatasetError: The file is missing or damaged.
    """
    try:
        content = json.loads(PACKAGED.read_text())
        found = {key: dict(content[key]) for key in ("versions", "parts", "tasks")}
        machine = found["versions"].pop("machine", None)  # of files that named the architecture alone
        return found if machine is None else found | {"versions": found["versions"] | {"cpu": f"{machine} with FMA"}}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{PACKAGED.name} that cannot be read ({error})", "digests", "reinstall the package"
        ) from None


def differing_versions() -> tuple[str, ...]:
    """Return what differs between this machine's versions and those of the packaged digests, a line each."""
    return provenance.bit_differences(packaged()["versions"])


def _digest(content: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for piece in content:
        digest.update(piece)
    return digest.hexdigest()


def _sensed(rng: np.random.Generator, count: int) -> Proprioception:
    """Return made-up proprioception of robots about their home pose."""
    quat_wxyz = np.array([1.0, 0.0, 0.0, 0.0]) + 0.05 * rng.uniform(-1, 1, (count, 4))
    quat_wxyz /= np.sqrt((quat_wxyz**2).sum(axis=1, keepdims=True))
    joints = len(g1.BODY_JOINTS)
    return Proprioception(
        quat_wxyz=quat_wxyz,
        gyro=rng.uniform(-0.5, 0.5, (count, 3)),
        q=g1.HOME + rng.uniform(-0.2, 0.2, (count, joints)),
        dq=rng.uniform(-1, 1, (count, joints)),
    )


def _poses() -> Iterable[bytes]:
    """Yield made-up poses in every way in which they are combined, one by one and together, and walks along them."""
    rng = np.random.default_rng(4)
    T = poses.from_rotation(
        poses.rotation_from_rpy(rng.uniform(-3, 3, (2, _POSES, 3))), rng.normal(size=(2, _POSES, 3))
    )
    points, velocities = rng.normal(size=(_POSES, 3)), rng.uniform(-0.5, 0.5, (_POSES, 3))
    settings = LocomotionSettings()
    for a, b, point, velocity in zip(*T, points, velocities, strict=True):
        motion = poses.invert(a) @ b
        yield motion.tobytes() + poses.transform(motion, point).tobytes() + poses.interpolate(a, b, 0.3).tobytes()
        here, goal = poses.to_planar(a), poses.to_planar(b)
        yield walk_velocity(here, velocity, goal, settings).tobytes()
    motion = poses.invert(T[0]) @ T[1]
    yield motion.tobytes() + poses.transform(motion, points).tobytes() + poses.interpolate(T[0], T[1], 0.3).tobytes()
    yield poses.rpy(motion[:, :3, :3]).tobytes() + np.concatenate(poses.split(motion), axis=-1).tobytes()


def _controller() -> Iterable[bytes]:
    rng, controller = np.random.default_rng(1), WholeBodyController(_WORLDS)
    controller.reset(np.arange(_WORLDS), _sensed(rng, _WORLDS))
    low, high = command.LOWER, command.UPPER
    for tick in range(_TICKS):
        if tick % 20 == 0:
            commands = low + rng.random((_WORLDS, command.SIZE)) * (high - low)
            commands[: _WORLDS // 2, command.VELOCITY] = 0.0
        yield controller.step(_sensed(rng, _WORLDS), commands).tobytes()
    yield controller.state.tobytes()


def _inverse_kinematics() -> Iterable[bytes]:
    rng, sim = np.random.default_rng(2), Simulation(get_task(_PROBE))
    solver, previous = WholeBodyIK(sim.model), command.rest()
    hands = [sim.pose(f"{side}_palm")[0] for side in g1.SIDES]
    for _ in range(_SOLUTIONS):
        targets = [hand.copy() for hand in hands]
        for target in targets:
            target[:3, 3] += rng.uniform(-0.3, 0.3, 3)
        solution = solver.solve(
            T_world_pelvis=sim.pose("pelvis")[0],
            joint_positions=g1.HOME,
            T_world_left=targets[0],
            T_world_right=targets[1],
            previous=previous,
        )
        previous = solution.command
        yield previous.tobytes() + solution.position_error.tobytes()
    sim.close()


def _physics() -> Iterable[bytes]:
    rng, sim = np.random.default_rng(3), Simulation(get_task(_PROBE), num_worlds=2)
    yield provenance.model_hash(sim.model).encode()
    for _ in range(_STEPS):
        commands = np.tile(command.rest(), (2, 1))
        commands[:, command.ARMS] += rng.uniform(-0.3, 0.3, commands[:, command.ARMS].shape)
        sim.step(commands)
        for _, values in sorted(sim.snapshot().items()):
            yield values.tobytes()
    sim.close()


def _attempts(
    task: Task, count: int, region: str = DEFAULT_REGION, settings: Settings | None = None
) -> Iterable[bytes]:
    """Yield what attempts of a task come to as `demohlm generate` makes them: packaged demonstration, seed 0."""
    attempts = Attempts(task, demonstrations.load(None, task), region, 0, count, settings or Settings())
    try:
        for episode in attempts.run(range(count)):
            yield f"{episode.digest} {episode.outcome} {episode.stage} {GENERATION_STREAM}".encode()
            yield episode.success.tobytes() + episode.state.tobytes() + episode.environment_state.tobytes()
    finally:
        attempts.close()

"""Palm targets all over the workspace -> how near the palms come, standing and walking: ``demohlm benchmark reach``.

Inverse kinematics at 10 Hz, which for a walking robot foresees its pelvis's motion (``control.foresight``, which
generation and deployment do not use), whole-body controller at 50 Hz, physics at 500 Hz, where palms
and pelvis are measured. Targets are palm poses of random admissible commands, so each can be reached, and they are
thinned to be uniform in space. A standing robot's targets are fixed in the world; a walking one's in the frame that
follows its pelvis's mean way and heading.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command, gait_clock
from gym_demohlm.control.foresight import Foresight
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import PHYSICS_DT, STEP_DT
from gym_demohlm.wbc.evaluation.commanded_posture import Figure
from gym_demohlm.wbc.evaluation.trial_commands import ARM_MIRROR

# Arm poses in front of and beside the body [rad]: shoulder pitch, roll, yaw, elbow, wrist roll, pitch, yaw; left arm.
_ARM_LOW = np.array([-2.2, -0.1, -0.8, -0.9, -0.8, -0.8, -0.8])
_ARM_HIGH = np.array([0.6, 1.2, 0.8, 1.5, 0.8, 0.8, 0.8])
_TORSO_LOW, _TORSO_HIGH = command.LOWER[command.TORSO], command.UPPER[command.TORSO]
_WALKING_TORSO_LOW, _WALKING_TORSO_HIGH = np.array([0.64, 0.0, -0.2, 0.0]), np.array([0.74, 0.0, 0.3, 0.0])
_NEAREST, _LOWEST = 0.15, 0.05  # m ahead of the soles, above the floor: where targets begin
_CELL = 0.08  # m, edge of the cells among which targets are drawn uniformly

STANDING_TOLERANCE, WALKING_TOLERANCE = 0.01, 0.02  # m
WALKING_SPEED = (0.2, 0.3)  # m/s
GAIT_SAMPLES = round(gait_clock.GAIT.period_s / PHYSICS_DT)


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Times of one reach [s]: start, bring the palms to their targets, hold them there, be measured at the end."""

    lead_in: float = 0.0
    transit: float = 2.0
    hold: float = 2.5
    measured: float = 1.0


STANDING = Schedule()
WALKING = Schedule(lead_in=2.0, transit=1.5, hold=3.5, measured=2.0)


@dataclass(frozen=True, kw_only=True)
class Reaches:
    """What became of some targets.

    Attributes:
        errors: Mean distance of each palm from its target while it was measured, (M, 2) [m]; NaN without a target.
        fallen: (M,) whose robot fell.
    """

    errors: np.ndarray
    fallen: np.ndarray


def draw_targets(
    figure: Figure, count: int, rng: np.random.Generator, *, walking: bool = False, candidates: int = 3000
) -> np.ndarray:
    """Draw palm poses that some command reaches, uniform in the space that the palms sweep.

    The controller leaves out some postures of that range, see ``control.reference``: of one target in 55, a palm is
    then more than 1 cm from where its command would have it. Another posture may reach it.

    Args:
        figure: The robot.
        count: M.
        rng: Source of the commands and the choice.
        walking: Whether the torso keeps to what a walking robot may do; its targets are then in the frame on the floor
            below the pelvis instead of below the middle of the soles.
        candidates: Commands tried.

    Returns:
        (M, 2, 4, 4); the even rows are meant for both hands, the odd ones for the left and right hand by turns.
    """
    low, high = (_WALKING_TORSO_LOW, _WALKING_TORSO_HIGH) if walking else (_TORSO_LOW, _TORSO_HIGH)
    wanted, found = command.rest(), []
    for _ in range(candidates):
        wanted[command.TORSO] = rng.uniform(low, high)
        wanted[command.LEFT_ARM] = rng.uniform(_ARM_LOW, _ARM_HIGH)
        wanted[command.RIGHT_ARM] = rng.uniform(_ARM_LOW, _ARM_HIGH) * ARM_MIRROR
        palms = figure.stand(wanted)
        ahead = (palms[:, 0, 3] > _NEAREST).all() and (palms[:, 2, 3] > _LOWEST).all()
        if ahead and not figure.collides():
            if walking:
                palms[:, :2, 3] -= figure.pelvis()[:2]
            found.append(palms)
    palms = np.stack(found)
    chosen = np.zeros((count, 2, 4, 4))
    cells = [np.unique(np.floor(palms[:, hand, :3, 3] / _CELL), axis=0, return_inverse=True)[1] for hand in (0, 1)]
    for row in range(count):
        members = cells[(row // 2) % 2].ravel()
        chosen[row] = palms[rng.choice(np.flatnonzero(members == rng.integers(members.max() + 1)))]
    return chosen


def hands_of(count: int) -> np.ndarray:
    """Return which hands take part, (count, 2) bool: both, left, both, right, and again."""
    rows = np.arange(count)
    both = rows % 2 == 0
    return np.stack([both | (rows % 4 == 1), both | (rows % 4 == 3)], axis=1)


def reach_standing(simulation: Simulation, targets: np.ndarray, hands: np.ndarray) -> Reaches:
    """Let standing robots reach from rest; targets (M, 2, 4, 4) below whose origin is the middle of the soles."""

    def one_round(places: np.ndarray, use: np.ndarray) -> Reaches:
        ik = _begin(simulation)
        soles = np.mean([simulation.pose(f"{side}_sole") for side in g1.SIDES], axis=0)
        stance = poses.planar(soles[:, 0, 3], soles[:, 1, 3], poses.yaw(simulation.pose("pelvis")))
        T_world_start, T_world_goal = _palms(simulation), stance[:, None] @ places
        measured: list[np.ndarray] = []
        for share in _shares(STANDING):
            now = poses.interpolate(T_world_start, T_world_goal, np.full(places.shape[:2], share))
            commands, T_world_pelvis, q = simulation.command, simulation.pose("pelvis"), simulation.joint_positions
            for world in range(simulation.num_worlds):
                commands[world] = ik.solve(
                    T_world_pelvis=T_world_pelvis[world],
                    joint_positions=q[world],
                    T_world_left=now[world, 0] if use[world, 0] else None,
                    T_world_right=now[world, 1] if use[world, 1] else None,
                    previous=commands[world],
                ).command
            simulation.step(commands)
            measured.append(_readings(simulation, "palm_pos", g1.SIDES))
        last = np.concatenate(measured[-round(STANDING.measured / STEP_DT) :], axis=1)
        errors = np.linalg.norm(last - T_world_goal[:, None, :, :3, 3], axis=-1).mean(axis=1)
        return Reaches(errors=errors, fallen=simulation.fallen() | simulation.unstable)

    return _rounds(simulation, targets, hands, one_round)


def reach_walking(
    simulation: Simulation, targets: np.ndarray, hands: np.ndarray, rng: np.random.Generator, foresight: bool = True
) -> Reaches:
    """Let robots that walk slowly ahead reach and hold.

    Args:
        simulation: Of ``trial_task``.
        targets: (M, 2, 4, 4) in the frame on the floor that follows the pelvis's mean way and heading.
        hands: (M, 2) bool, which take part.
        rng: Source of the speeds.
        foresight: Whether the arms go by where the torso will be; otherwise by where it was measured.
    """

    def one_round(places: np.ndarray, use: np.ndarray) -> Reaches:
        ik, schedule = _begin(simulation), WALKING
        worlds = range(simulation.num_worlds)
        views = [Foresight() for _ in worlds]
        speeds = rng.uniform(*WALKING_SPEED, len(worlds))
        T_heading_start = poses.invert(poses.planar(*_planar(simulation)))[:, None] @ _palms(simulation)
        palms: list[np.ndarray] = []
        pelvis: list[np.ndarray] = []
        for share in _shares(schedule):
            T_heading_now = poses.interpolate(T_heading_start, places, np.full(places.shape[:2], share))
            commands, T_world_pelvis, q = simulation.command, simulation.pose("pelvis"), simulation.joint_positions
            for world in worlds:
                outlook = views[world].see(T_world_pelvis[world], q[world])
                frame = outlook.T_world_heading if foresight else poses.planar(*poses.to_planar(T_world_pelvis[world]))
                now = frame @ T_heading_now[world]
                commands[world] = ik.solve(
                    T_world_pelvis=outlook.T_world_pelvis if foresight else T_world_pelvis[world],
                    joint_positions=outlook.joint_positions if foresight else q[world],
                    T_world_left=now[0] if use[world, 0] and share > 0 else None,
                    T_world_right=now[1] if use[world, 1] and share > 0 else None,
                    previous=commands[world],
                    T_world_heading=frame,
                    walking=True,
                ).command
            commands[:, command.VELOCITY] = np.stack([speeds, 0 * speeds, 0 * speeds], axis=1)
            simulation.step(commands)
            palms.append(_readings(simulation, "palm_pos", g1.SIDES))
            pelvis.append(
                np.concatenate([_readings(simulation, name, ("pelvis",)) for name in ("pos", "quat")], axis=-1)
            )
        frames = _mean_frames(np.concatenate(pelvis, axis=1)[:, :, 0])
        p_world_palms = np.concatenate(palms, axis=1)
        goals = poses.transform(frames[:, :, None], places[:, None, :, :3, 3])
        distance = np.linalg.norm(p_world_palms - goals, axis=-1)
        last = slice(-round(schedule.measured / PHYSICS_DT) - GAIT_SAMPLES // 2, -GAIT_SAMPLES // 2)
        return Reaches(errors=distance[:, last].mean(axis=1), fallen=simulation.fallen() | simulation.unstable)

    return _rounds(simulation, targets, hands, one_round)


def hand_error(simulation: Simulation, seed: int, rounds: int = 4) -> dict[str, float]:
    """Measure how near palms come to targets all over the workspace.

    Args:
        simulation: Of ``trial_task``; reset here. Every world reaches once a round.
        seed: Of targets and speeds.
        rounds: Of standing robots, and as many of walking ones.

    Returns:
        Mean and 95th percentile of the distance [m] of palms whose robot did not fall, the share of palms within
        STANDING_TOLERANCE or WALKING_TOLERANCE of their target among all, the share of robots that fell, each for
        standing and walking; and the number of reaches of each kind.
    """
    rng = np.random.default_rng(seed)
    figure = Figure(simulation.model, Weights().make_reference())
    count = rounds * simulation.num_worlds
    hands = hands_of(count)
    standing = reach_standing(simulation, draw_targets(figure, count, rng), hands)
    walking = reach_walking(simulation, draw_targets(figure, count, rng, walking=True), hands, rng)
    found: dict[str, float] = {}
    for suffix, reaches, tolerance in (("", standing, STANDING_TOLERANCE), ("_walking", walking, WALKING_TOLERANCE)):
        upright = reaches.errors[np.isfinite(reaches.errors) & ~reaches.fallen[:, None]]
        within = (reaches.errors < tolerance) & ~reaches.fallen[:, None]
        found[f"hand_error{suffix}"] = float(upright.mean()) if upright.size else float("nan")
        found[f"hand_error{suffix}_p95"] = float(np.percentile(upright, 95)) if upright.size else float("nan")
        found[f"hand{suffix}_within_{round(1000 * tolerance)}mm"] = float(within[hands].mean())
        found[f"hand{suffix}_fallen"] = float(reaches.fallen.mean())
    return {**found, "reaches": count}


def reach_map(
    simulation: Simulation, x: np.ndarray, z: np.ndarray, half: float = 0.15
) -> tuple[np.ndarray, np.ndarray]:
    """Let standing robots reach for every point of a grid, with the left hand and with both.

    Args:
        simulation: Of ``trial_task``.
        x: Distances ahead of the middle of the soles, (columns,) [m].
        z: Heights above the floor, (rows,) [m].
        half: Distance of a palm from the middle plane [m]. Fingers point ahead, down below 1 m, up above.

    Returns:
        Errors of one hand and the larger of both hands', (2, rows, columns) [m], and whether the robot fell, likewise.
    """
    height, ahead = (grid.ravel() for grid in np.meshgrid(z, x, indexing="ij"))
    tilt = np.clip(1.2 * (1.0 - height), -0.5, 1.0)
    rotation = poses.rotation_from_rpy(np.stack([0 * tilt, tilt, 0 * tilt], axis=1))
    places = [poses.from_rotation(rotation, np.stack([ahead, y + 0 * ahead, height], axis=1)) for y in (half, -half)]
    targets = np.tile(np.stack(places, axis=1), (2, 1, 1, 1))
    hands = np.stack([np.ones(len(targets), dtype=bool), np.arange(len(targets)) >= len(ahead)], axis=1)
    found = reach_standing(simulation, targets, hands)
    shape = (2, len(z), len(x))
    return np.fmax(found.errors[:, 0], found.errors[:, 1]).reshape(shape), found.fallen.reshape(shape)


def draw_map(path: Path, x: np.ndarray, z: np.ndarray, errors: np.ndarray, fallen: np.ndarray) -> None:
    """Draw what `reach_map` found: colour is the error, a cross a fall."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.colors import LogNorm

    figure, axes = pyplot.subplots(1, 2, figsize=(8, 5.2), sharey=True, layout="constrained")
    colours = pyplot.cm.ScalarMappable(LogNorm(1, 100, clip=True), "RdYlGn_r")
    across, up = np.meshgrid(x, z)
    for axis, title, error, fell in zip(axes, ("one hand", "both hands"), errors, fallen, strict=True):
        axis.pcolormesh(x, z, 1000 * error, norm=colours.norm, cmap=colours.cmap, shading="nearest")
        axis.contour(x, z, error, levels=[STANDING_TOLERANCE], colors="black")
        axis.scatter(across[fell], up[fell], marker="x", color="black")
        axis.set(title=title, xlabel="ahead of the middle of the feet [m]")
    axes[0].set_ylabel("height above the floor [m]")
    figure.colorbar(colours, ax=axes, label="palm to target [mm]; the line is 10 mm")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def measure_map(simulation: Simulation, step: float, path: Path) -> dict[str, Any]:
    """Let standing robots reach for every point of a grid, draw the map, and return its numbers.

    Args:
        simulation: Of ``trial_task``.
        step: Distance between points of the grid [m].
        path: PNG file to draw into.

    Returns:
        Places of the grid "map_x" and "map_z" [m]; for "one_hand" and "both_hands" the errors "map_..." [m], a row a
        height, and the share of the grid "map_..._within_10mm" that is reached by a robot that does not fall.
    """
    x, z = np.arange(0.1, 0.7001, step), np.arange(0.1, 1.5001, step)
    errors, fallen = reach_map(simulation, x, z)
    draw_map(path, x, z, errors, fallen)
    found: dict[str, Any] = {"map_x": np.round(x, 3).tolist(), "map_z": np.round(z, 3).tolist()}
    for name, error, fell in zip(("one_hand", "both_hands"), errors, fallen, strict=True):
        found[f"map_{name}"] = np.round(error, 4).tolist()
        found[f"map_{name}_within_10mm"] = float(((error < STANDING_TOLERANCE) & ~fell).mean())
    return found


def _begin(simulation: Simulation) -> WholeBodyIK:
    simulation.reset([simulation.task.default_state()] * simulation.num_worlds)
    return WholeBodyIK(simulation.model)


def _rounds(
    simulation: Simulation,
    targets: np.ndarray,
    hands: np.ndarray,
    one_round: Callable[[np.ndarray, np.ndarray], Reaches],
) -> Reaches:
    """Give each world one target a round; the last round is filled up with its first target."""
    count, worlds = len(targets), simulation.num_worlds
    errors, fallen = np.full((count, 2), np.nan), np.zeros(count, dtype=bool)
    for first in range(0, count, worlds):
        rows = np.arange(first, min(first + worlds, count))
        padded = np.concatenate([rows, np.full(worlds - len(rows), first)])
        found = one_round(targets[padded], hands[padded])
        errors[rows] = np.where(hands[rows], found.errors[: len(rows)], np.nan)
        fallen[rows] = found.fallen[: len(rows)]
    return Reaches(errors=errors, fallen=fallen)


def _shares(schedule: Schedule) -> np.ndarray:
    """Return how much of the way to its target each step asks for: 0 before, 1 after, smooth between."""
    steps = round((schedule.lead_in + schedule.transit + schedule.hold) / STEP_DT)
    share = np.clip((STEP_DT * np.arange(1, steps + 1) - schedule.lead_in) / schedule.transit, 0.0, 1.0)
    return share**2 * (3 - 2 * share)


def _palms(simulation: Simulation) -> np.ndarray:
    return np.stack([simulation.pose(f"{side}_palm") for side in g1.SIDES], axis=1)


def _planar(simulation: Simulation) -> np.ndarray:
    return poses.to_planar(simulation.pose("pelvis")).T


def _readings(simulation: Simulation, quantity: str, frames: tuple[str, ...]) -> np.ndarray:
    """Return what frames' sensors read in the last step, (N, physics steps, frames, dim); NaN for worlds left out."""
    rows, first = simulation.readings(f"{frames[0]}_{quantity}")
    values = np.full((simulation.num_worlds, first.shape[1], len(frames), first.shape[2]), np.nan)
    for index, frame in enumerate(frames):
        values[rows, :, index] = simulation.readings(f"{frame}_{quantity}")[1]
    return values


def _mean_frames(pelvis: np.ndarray) -> np.ndarray:
    """Return the frames (N, T, 4, 4) that follow the pelvis (N, T, 7) averaged over the gait period around each time.

    Half a period at both ends is not averaged well.
    """
    yaw = np.unwrap(poses.rpy(poses.quat_to_matrix(pelvis[..., 3:]))[..., 2], axis=1)
    planar = np.concatenate([pelvis[..., :2], yaw[..., None]], axis=-1)
    box = np.full(GAIT_SAMPLES, 1.0 / GAIT_SAMPLES)
    smooth = np.array([[np.convolve(row[:, axis], box, "same") for axis in range(3)] for row in planar])
    return poses.planar(*np.moveaxis(smooth, 1, 0))

"""A task of your own, one demonstration of it, and generated episodes: PileCubes, all in this file.

Two cubes lie on a round table; the right gripper takes the red one and sets it on the blue one. The walk through this
file is ``docs/adding_a_task.md``. Run: ``uv run python examples/pile_cubes.py [DIRECTORY]``
"""

import math
import sys
from pathlib import Path

import mujoco
import numpy as np

from gym_demohlm import ObjectSpec, Task, Worlds, poses, register_task
from gym_demohlm.furniture import QUARTER_TURNS, add_cube, add_round_table
from gym_demohlm.task import REGIONS, InitialState, limit_yaw
from lerobot_demohlm.generation.runner import GenerationRequest, generate
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint
from lerobot_demohlm.teleop.record import Script, record, register_script

# The task: scene, success, failure, regions

TABLE_RADIUS, TABLE_HEIGHT = 0.18, 0.75  # m
RED_EDGE, RED_MASS = 0.05, 0.10  # m, kg
BLUE_EDGE, BLUE_MASS = 0.06, 0.25  # m, kg
GAP = 1e-4  # m, cubes begin so far above the table: faces exactly in one plane can give MuJoCo's collider a false depth
BLUE_POSITION = (0.35, 0.0, TABLE_HEIGHT + BLUE_EDGE / 2 + GAP)
RED_POSITION = (0.35, -0.11, TABLE_HEIGHT + RED_EDGE / 2 + GAP)
STACKED = (RED_EDGE + BLUE_EDGE) / 2  # m, the red cube's centre above the blue one's
LEVEL = 0.006  # m, how well that height must fit
OVER = 0.025  # m, the red cube's centre from the blue one's seen from above
DROP = 0.04  # m below its start


def build(spec: mujoco.MjSpec) -> None:
    """Add table and cubes to the robot's world."""
    add_round_table(spec, BLUE_POSITION[:2], TABLE_RADIUS, TABLE_HEIGHT)
    add_cube(spec, "blue", BLUE_POSITION, BLUE_EDGE, BLUE_MASS, rgba=(0.20, 0.45, 0.75, 1.0))
    add_cube(spec, "red", RED_POSITION, RED_EDGE, RED_MASS)


def stacked(sim: Worlds) -> np.ndarray:
    """Return whether (N,) the red cube rests on the blue one and on nothing else."""
    apart = sim.pose("red")[:, :3, 3] - sim.pose("blue")[:, :3, 3]
    on_top = (np.abs(apart[:, 2] - STACKED) < LEVEL) & (np.hypot(apart[:, 0], apart[:, 1]) < OVER)
    weight = RED_MASS * 9.81
    let_go = sim.contact_force("right", "red") == 0.0
    return on_top & let_go & (sim.pair_force("red", "blue") > 0.5 * weight)


def dropped(sim: Worlds) -> np.ndarray:
    """Return whether (N,) a cube has fallen off the table."""
    return np.any([sim.pose(name)[:, 2, 3] < sim.start_pose(name)[:, 2, 3] - DROP for name in ("red", "blue")], axis=0)


TASK = Task(
    name="PileCubes",
    description="Pick up the red cube with the right gripper and set it on the blue cube.",
    hands="gripper",
    build=build,
    objects=(
        ObjectSpec(name="red", position=RED_POSITION, symmetry=QUARTER_TURNS, moves_with="blue"),
        ObjectSpec(name="blue", position=BLUE_POSITION, symmetry=QUARTER_TURNS),
    ),
    success=stacked,
    failures={"dropped": dropped},
    gaze_target="red",
    supports=("table",),
    obstacles=("table",),
    contact_pairs=(("right", "red"),),
    force_pairs=(("red", "blue"),),
    motion_frame="scene",
    regions=limit_yaw(REGIONS, math.pi / 4),  # the red cube stays on the right
    episode_length_s=35.0,
)
register_task(TASK)

# The scripted operator: it stands in for a person with a headset

START: InitialState = {"robot": [-0.06, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: 0.41 m before the blue cube."""
TILT = 0.3  # rad, fingers down
GRIP = (-0.005, 0.0, 0.010)  # m, the palm from the cube's centre: the finger tips stay clear of what is below the cube
ABOVE_BLUE = 0.006  # m, the red cube is let go at this height above the blue one
CLEAR = 0.08  # m above the blue cube on the way there
BESIDE = (0.16, -0.26, 0.0)  # m, the right palm from the pelvis while it goes up past the table's rim
LEFT_ASIDE = (0.20, 0.28, 0.72)  # m, the left palm in the base frame, clear of the table
OPEN, CLOSED = (0.0, 0.0), (0.0, 1.0)  # left and right gripper
PALM = poses.rotation_from_rpy([0.0, TILT, 0.0])


def make_operator() -> PathOperator:
    """Return the operator: each phase is planned when it begins, from where things are then."""
    return PathOperator("scripted: pile_cubes", [take, stack])


def take(view: SceneView) -> list[Waypoint]:
    """Plan the way to the red cube and up."""
    centre = view.T_world_objects["red"][:3, 3]
    beside = view.T_world_pelvis[:3, 3] + BESIDE

    def go(x: float, z: float, seconds: float, grippers: tuple[float, float] = OPEN, watched: bool = False) -> Waypoint:
        palm = centre + np.array(GRIP) + np.array([x, 0.0, z])
        return _waypoint(view, palm, seconds, grippers, watched)

    return [
        _waypoint(view, np.array([*beside[:2], centre[2] + 0.10]), 1.4, OPEN, False),
        go(-0.13, 0.10, 1.2),
        go(-0.10, 0.03, 1.0, watched=True),
        go(0.0, 0.0, 1.4, watched=True),
        go(0.0, 0.0, 1.0, watched=True),
        go(0.0, 0.0, 0.8, CLOSED),
        go(-0.01, STACKED + CLEAR, 1.6, CLOSED),
        go(-0.01, STACKED + CLEAR, 0.6, CLOSED),
    ]


def stack(view: SceneView) -> list[Waypoint]:
    """Plan the way over the blue cube and down, letting go, and the way back; the red cube is in the hand."""
    held = view.T_world_objects["red"][:3, 3] - view.T_world_hands[1][:3, 3]
    centre = view.T_world_objects["blue"][:3, 3] + [0.0, 0.0, STACKED + ABOVE_BLUE] - held

    def go(x: float, z: float, seconds: float, grippers: tuple[float, float] = OPEN) -> Waypoint:
        palm = centre + np.array([x, 0.0, z])
        return _waypoint(view, palm, seconds, grippers, watched=grippers == CLOSED)

    return [
        go(0.0, CLEAR, 1.6, CLOSED),
        go(0.0, CLEAR, 0.8, CLOSED),
        go(0.0, 0.0, 1.6, CLOSED),
        go(0.0, 0.0, 1.2, CLOSED),
        go(0.0, 0.0, 0.8),
        go(-0.13, 0.04, 1.6),
        go(-0.13, 0.04, 1.6),
    ]


def _waypoint(
    view: SceneView, palm: np.ndarray, seconds: float, grippers: tuple[float, float], watched: bool
) -> Waypoint:
    """Return a waypoint for the right palm (3,) [m, world]; the left one waits aside."""
    base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    hands = np.stack([base @ poses.from_rotation(np.eye(3), LEFT_ASIDE), poses.from_rotation(PALM, palm)])
    return Waypoint(T_world_hands=hands, duration_s=seconds, grippers=grippers, watched=watched)


register_script(TASK, Script(start=START, make_operator=make_operator))


def main(directory: Path, num_attempts: int = 8) -> None:
    """Record the demonstration, generate attempts in R1 and R3, and print how many succeeded."""
    demonstration = directory / "demonstration"
    record(TASK, make_operator(), START).save(demonstration, TASK)
    for region in ("R1", "R3"):
        summary = generate(
            GenerationRequest(
                task=TASK.name,
                region=region,
                seed=0,
                root=directory / region.lower(),
                num_attempts=num_attempts,
                demonstration=demonstration,
            )
        )
        print(f"{region}: {summary.successes} of {summary.attempts} attempts succeeded: {summary.outcomes}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("outputs/pile_cubes"))

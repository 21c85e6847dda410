"""The environment by hand: walk two seconds, squat and bend, come up, and save a picture of each.

Run: ``uv run python examples/drive_by_hand.py [DIRECTORY]``
"""

import sys
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np

import gym_demohlm  # noqa: F401  (registers the environments)
from gym_demohlm.control import command


def main(directory: Path) -> None:
    """Drive LiftBox's robot and write one PNG a phase."""
    directory.mkdir(parents=True, exist_ok=True)
    env = gym.make("DemoHLM/LiftBox-v0", region="R3", render_mode="rgb_array")
    _, info = env.reset(seed=0)
    print("started at", info["initial_state"])

    walk = command.rest()
    walk[command.VELOCITY] = 0.2, 0.0, 0.3  # m/s forward, m/s left, rad/s to the left
    squat = command.rest()
    squat[command.HEIGHT], squat[command.PITCH] = 0.55, 0.5  # m, rad

    for name, action, seconds in (("walk", walk, 2.0), ("stand", command.rest(), 2.0), ("squat", squat, 2.0)):
        for _ in range(round(10 * seconds)):
            observation, _, terminated, _, info = env.step(action.astype(np.float32))
            if terminated:
                raise SystemExit(f"the robot fell while it should {name}")
        iio.imwrite(directory / f"{name}.png", env.render())
        pitch = np.degrees(observation["agent_pos"][-1])
        print(f"{name}: torso pitch {pitch:.0f} degrees, box at {observation['environment_state'][:3].round(2)} m")
    env.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("outputs/drive_by_hand"))

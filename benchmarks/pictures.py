"""A dataset or a policy -> film strips for the documentation.

``uv run python benchmarks/pictures.py episode --root data/lift_box --episode 0 --output docs/lift_box_episode.png``
simulates a generated episode again from its stored start and commands, and draws it;
``... policy --policy outputs/.../pretrained_model --region R2 --output docs/lift_box_policy.png`` draws a rollout.
"""

import argparse
from pathlib import Path

import numpy as np

from gym_demohlm.rendering import Renderer
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import get_task
from lerobot_demohlm.dataset import read_attempts, read_facts
from lerobot_demohlm.report import Film, film_strip


def episode_film(root: Path, episode: int, camera: str) -> Film:
    """Simulate an episode of a dataset again and draw every tick.

    Raises:
        SystemExit: The simulation does not end in success, as the stored episode does.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    task = get_task(read_facts(root)["task"])
    made = [record for record in read_attempts(root) if record["outcome"] == "success"][episode]
    dataset = LeRobotDataset("local/pictures", root=root, episodes=[episode])
    actions = np.stack([np.asarray(frame) for frame in dataset.hf_dataset["action"]]).astype(np.float64)
    simulation = Simulation(task)
    simulation.reset([made["initial_state"]])
    frames = []
    with Renderer(simulation.model) as renderer:
        for action in actions:
            simulation.step(action[None])
            frames.append(renderer.render(simulation.mj_data(), camera))
    if not simulation.success()[0]:
        raise SystemExit(f"episode {episode} does not succeed when it is simulated again")
    return Film(frames=frames, caption=f"attempt {made['attempt']}")


def policy_film(policy: Path, task: str, region: str, seed: int) -> Film:
    """Roll a policy out once and draw every tick."""
    from lerobot_demohlm.evaluation import load_policy, rollouts
    from lerobot_demohlm.quickstart import Recorder

    recorder = Recorder()
    (record,) = rollouts(load_policy(policy, task), task, region, [seed], num_worlds=1, on_step=recorder)
    print(record)
    return Film(frames=recorder.frames, caption=record["outcome"])


def main() -> None:
    """Draw what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("episode", "policy"))
    parser.add_argument("--root", type=Path, help="dataset of generated episodes")
    parser.add_argument("--episode", type=int, default=0)
    parser.add_argument("--camera", choices=("overview", "head"), default="overview")
    parser.add_argument("--policy", type=Path, help="pretrained_model of lerobot-train")
    parser.add_argument("--task", default="LiftBox")
    parser.add_argument("--region", default="R2")
    parser.add_argument("--seed", type=int, default=1_000_000)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    if arguments.kind == "episode":
        film = episode_film(arguments.root, arguments.episode, arguments.camera)
    else:
        film = policy_film(arguments.policy, arguments.task, arguments.region, arguments.seed)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_bytes(film_strip(film))


if __name__ == "__main__":
    main()

"""``demohlm evaluate``."""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import PolicyError
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.choices import Masks, Perception
from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.evaluation.evaluate import FIRST_SEED, MAX_SEED, evaluate, summarize
from lerobot_demohlm.evaluation.loaded_policy import load_policy
from lerobot_demohlm.evaluation.rollouts import NUM_WORLDS, Setting


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm evaluate``.

    Attributes:
        policy: A pretrained_model directory of `demohlm train` or lerobot-train.
        task: Name of the task, such as LiftBox.
        region: Initial region, R1 to R4.
        variation: How worlds differ: none, real or hard, or groups of them such as "real:objects+pushes".
        num_episodes: Rollouts.
        seed: Seed of the first rollout; the next one has the next seed.
        num_worlds: Rollouts at a time in a process.
        num_threads: Threads of the physics in a process.
        num_workers: Processes.
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
        output: File for the JSON lines, one a rollout; where it exists, the rollouts in it are kept.
        device: Where the policy runs, such as "cuda".
        perception: How the policy and the neck see objects: exactly, with a fitted error, by a tracker of a drawn depth
            camera's images, by tags, or by a pose server.
        masks: Which pixels are an object's, for `rgbd` and `remote`: the renderer's with rough edges, those of its
            colours, or left to the server.
        camera_error: Angle by which the camera is mounted otherwise than the robot knows [degrees]; with each degree go
            5 mm and 0.5 % of focal length.
        mesh_scale: Size of the known meshes over that of the objects.
        bias_mm: Distance by which each episode tells each object elsewhere [mm].
        latency_s: Age of the poses [s], in steps of 0.1 s.
        dropout: Share of frames from which no pose comes.
        address: Of the pose server, for `remote`.
    """

    policy: Path
    task: str
    region: str = DEFAULT_REGION
    variation: str = "none"
    num_episodes: int = 50
    seed: int = FIRST_SEED
    num_worlds: int = NUM_WORLDS
    num_threads: int = 1
    num_workers: int = 1
    controller: str = "default"
    output: Annotated[Path | None, default("none")] = None
    device: str = "cpu"
    perception: Perception = "exact"
    masks: Masks = "oracle"
    camera_error: float = 0.0
    mesh_scale: float = 1.0
    bias_mm: float = 0.0
    latency_s: float = 0.0
    dropout: float = 0.0
    address: str = "tcp://127.0.0.1:5570"


def run(options: Options) -> None:
    """Roll a policy out; the last line on stdout is the summary as JSON.

    Raises:
        UnknownNameError: No such task, region or controller.
        PolicyError: The policy does not fit, or a count is not positive.
        DatasetError: The output holds rollouts of something else.
    """
    import torch

    if options.num_episodes < 1 or not 0 <= options.seed <= MAX_SEED - options.num_episodes:
        raise PolicyError(
            f"num_episodes={options.num_episodes}, seed={options.seed}",
            f"at least one episode and seeds from 0 to {MAX_SEED}",
            "correct them",
        )
    names = ("masks", "camera_error", "mesh_scale", "bias_mm", "latency_s", "dropout", "address")
    perception = PerceptionSettings(source=options.perception, **{name: getattr(options, name) for name in names})
    setting = Setting(
        task=options.task,
        region=options.region,
        variation=options.variation,
        num_worlds=options.num_worlds,
        num_threads=options.num_threads,
        num_workers=options.num_workers,
        controller=options.controller,
        perception=str(perception),
    )
    torch.set_num_threads(1)
    loaded = load_policy(options.policy, options.task, options.device)
    seeds = range(options.seed, options.seed + options.num_episodes)
    with tempfile.TemporaryDirectory() as scratch:
        rollouts = evaluate(loaded, setting, seeds, options.output or Path(scratch) / "rollouts.jsonl")
    facts = {"task": get_task(options.task).name, "region": options.region}
    if not perception.is_exact:
        facts["perception"] = str(perception)
    if setting.variation != "none":
        facts["variation"] = setting.variation
    print(json.dumps({**facts, **summarize(rollouts)}))

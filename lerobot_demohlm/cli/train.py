"""``demohlm train``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gym_demohlm.errors import PolicyError
from lerobot_demohlm.cli.choices import Policy, Preset
from lerobot_demohlm.cli.parsing import default

_DATA = tyro.conf.create_mutex_group(required=True, title="data")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm train``.

    Attributes:
        root: Dataset of `demohlm generate`.
        task: Short for --root data/TASK, such as data/lift_box for LiftBox.
        policy: Policy to train.
        preset: Hyperparameters.
        output: Directory of the training; must not exist.
        steps: Training steps.
        num_episodes: Train on this many episodes, from the first on.
        seed: Seed of the weights and of the order of the samples.
        device: Where the policy is trained, such as "cuda".
        num_threads: Threads of torch.
        write_config: Write the configuration for lerobot-train to this file, and train nothing.
    """

    root: Annotated[Path | None, _DATA, default("none")] = None
    task: Annotated[str | None, _DATA, default("none")] = None
    policy: Policy = "mlp"
    preset: Preset = "cpu"
    output: Annotated[Path | None, default("a directory in outputs")] = None
    steps: Annotated[int | None, default("the preset's")] = None
    num_episodes: Annotated[int | None, default("all")] = None
    seed: int = 0
    device: str = "cpu"
    num_threads: int = 1
    write_config: Annotated[Path | None, default("none")] = None


def run(options: Options) -> None:
    """Train; the last line on stdout is the path of the checkpoint, or of the configuration.

    Raises:
        DatasetError: There is no dataset, or the output exists.
        PolicyError: Fewer than one step, episode or thread, or an unknown device.
    """
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.datasets.facts import read_facts
    from lerobot_demohlm.datasets.origin import is_generated
    from lerobot_demohlm.policies.devices import require_device
    from lerobot_demohlm.policies.presets import train_config
    from lerobot_demohlm.policies.training import require_episodes, train, write_config

    if options.num_threads < 1:
        raise PolicyError(f"num_threads={options.num_threads}", "1 or more", "correct --num-threads")
    root = options.root or Path("data") / get_task(options.task or "").slug
    if not is_generated(root):
        read_facts(root)  # says what is missing
    output = options.output or Path("outputs") / f"{root.name}_{options.policy}_{options.preset}"
    chosen = {name: getattr(options, name) for name in ("steps", "seed", "num_episodes", "device")}
    if options.write_config is not None:
        require_episodes(root, options.num_episodes)
        require_device(options.device, here=False)
        config = train_config(root, output, options.policy, options.preset, **chosen)
        write_config(options.write_config, config)
        print(options.write_config)
        return
    print(train(output, root, options.policy, options.preset, **chosen, num_threads=options.num_threads))

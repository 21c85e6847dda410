"""DemoHLM for LeRobot: demonstrations in, datasets, policies and their scores out.

Importing this package is cheap. LeRobot learns of the environments and of the policy through ``lerobot_env_demohlm``,
which it imports by itself and which calls ``register``.
"""

import importlib


def register() -> None:
    """Make ``--env.type=demohlm`` and ``--policy.type=chunked_mlp`` known to LeRobot."""
    for module in ("lerobot_demohlm.evaluation.env_config", "lerobot_demohlm.policies.chunked_mlp"):
        importlib.import_module(module)

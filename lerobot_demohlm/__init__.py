"""DemoHLM for LeRobot: demonstrations in, datasets, policies and their scores out.

Importing this package is cheap. LeRobot learns of environments, policy, robot and teleoperators through
``lerobot_env_demohlm``, which it imports by itself and which calls ``register``.
"""

import importlib


def register() -> None:
    """Make ``--env.type=demohlm``, ``--policy.type=chunked_mlp``, our robot and teleoperators known to LeRobot."""
    for name in ("evaluation.env_config", "policies.chunked_mlp", "devices"):
        importlib.import_module(f"{__name__}.{name}")

"""DemoHLM for LeRobot: demonstrations in, datasets, policies and their scores out.

Importing this package is cheap. LeRobot learns of the environments and of the policy through ``lerobot_env_demohlm``,
which it imports by itself and which calls ``register``.
"""

import importlib


def register() -> None:
    """Make ``--env.type=demohlm``, ``--policy.type=chunked_mlp`` and the robots and teleoperators known to LeRobot."""
    modules = ("evaluation.env_config", "policies.chunked_mlp", "devices")
    for module in (f"{__name__}.{name}" for name in modules):
        importlib.import_module(module)

"""What LeRobot imports: a distribution called ``lerobot_env_...`` must bring a module of that very name."""

import lerobot_demohlm

lerobot_demohlm.register()

from lerobot_demohlm.datasets import in_memory  # noqa: E402  the environments are known even where this fails

in_memory.install()

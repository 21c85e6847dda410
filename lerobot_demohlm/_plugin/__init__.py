"""What LeRobot imports: a distribution called ``lerobot_env_...`` must bring a module of that very name."""

import lerobot_demohlm

lerobot_demohlm.register()

from lerobot_demohlm import loading  # noqa: E402  the environments are known even where this fails

loading.install()

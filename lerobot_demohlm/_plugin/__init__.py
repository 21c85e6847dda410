"""What LeRobot imports: a distribution called ``lerobot_env_...`` must bring a module of that very name."""

import lerobot_demohlm

lerobot_demohlm.register()

"""Tells LeRobot of everything: the module that ``--env.discover_packages_path=lerobot_demohlm`` comes across."""

import lerobot_demohlm

lerobot_demohlm.register()

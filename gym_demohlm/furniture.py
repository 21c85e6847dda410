"""What task files build scenes from, under its short name: ``gym_demohlm.scene.furniture``."""

from gym_demohlm.scene.furniture import *  # noqa: F403

"""Short name of ``gym_demohlm.scene.furniture``: what task files build scenes from."""

from gym_demohlm.scene.furniture import *  # noqa: F403

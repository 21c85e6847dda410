"""A task and the robot -> a compiled MuJoCo model, and what task files build scenes from."""

from gym_demohlm.scene.building import aim_overview as aim_overview
from gym_demohlm.scene.building import scene_spec as scene_spec
from gym_demohlm.scene.scene import Scene as Scene
from gym_demohlm.scene.scene import build_scene as build_scene

"""Gymnasium environments of G1 loco-manipulation tasks; importing it registers each task as ``DemoHLM/<Task>-v0``."""

from gym_demohlm.task import all_tasks as _all_tasks

_all_tasks()

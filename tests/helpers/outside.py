"""A task whose module lies outside of the package, edited and imported anew as by a process that starts later."""

import importlib
import sys
from pathlib import Path

from gym_demohlm import registry
from gym_demohlm.task import Task
from lerobot_demohlm.reproducibility import provenance

MODULE, NAME = "task_from_outside", "FromOutside"
_TEXT = """
from dataclasses import replace
from gym_demohlm.registry import get_task, register_task

def succeeds(sim):
    return sim.time > {after_s}

TASK = register_task(
    replace(get_task("LiftBox"), name="FromOutside", episode_length_s=0.5, success=succeeds, failures={{}})
)
"""


def bring_task(folder: Path, after_s: float) -> Task:
    """Write the module, whose task succeeds after a time [s], and import it; the folder must be on Python's path."""
    (folder / f"{MODULE}.py").write_text(_TEXT.format(after_s=after_s))
    sys.modules.pop(MODULE, None)
    registry._registered.pop(NAME, None)
    provenance._source_hash.cache_clear()
    importlib.invalidate_caches()
    sys.dont_write_bytecode, before = True, sys.dont_write_bytecode  # else a second's edits share a cached file
    try:
        return importlib.import_module(MODULE).TASK
    finally:
        sys.dont_write_bytecode = before

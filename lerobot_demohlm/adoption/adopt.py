"""All checks of a new controller, one after another and each once, and then the switch.

What was found is kept in ``found.jsonl`` of the work directory, so that a call that was killed goes on. The first check
that falls short ends it: nothing is changed then, and what fell short is said.
"""

import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl
from gym_demohlm.control import controllers
from gym_demohlm.control.whole_body import WEIGHTS_FOLDER, Weights
from gym_demohlm.errors import DemoHLMError
from gym_demohlm.registry import get_task
from lerobot_demohlm.adoption.steps import Found, Request, packaged_tasks, plan
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.reproducibility.run_lock import RunLock

FOUND = "found.jsonl"


class NotAdoptedError(DemoHLMError):
    """A controller that falls short."""


def check(request: Request, say: Callable[[str], None] = lambda _: None) -> list[dict[str, Any]]:
    """Make the checks that are missing; returns what all of them found.

    Args:
        request: What to check.
        say: Called with the name of each check before it is made, and with what was found before.

    Raises:
        SceneError: The weights file is missing, damaged or of another format.
        DatasetError: Another process is at work in the directory.
        NotAdoptedError: A check fell short.
    """
    key = request.key
    request.work.mkdir(parents=True, exist_ok=True)
    lock = RunLock(request.work)
    try:
        path = request.work / FOUND
        known = {line["check"]: line for line in (jsonl.read(path) if path.exists() else []) if line["key"] == key}
        for name, make in plan(request):
            if name not in known:
                say(name)
                found: Found = make()
                line = {"check": name, "key": key, **asdict(found), "failures": list(found.failures)}
                jsonl.append(path, [line])
                known[name] = line
            if short := known[name]["failures"]:
                raise NotAdoptedError(
                    f"a controller that falls short in {name}: {'; '.join(short)}",
                    "no number worse than the default controller's, and every task done",
                    f"train on; nothing was changed, and {path} holds what was found",
                )
        return list(known.values())
    finally:
        lock.release()


def switch(request: Request, folder: Path = WEIGHTS_FOLDER) -> str:
    """Make a checked controller the default one, with its demonstrations; returns its name.

    A call that was killed is completed by the same call: files appear whole, the demonstration of a task by one rename,
    and the name of the default controller comes last.

    Args:
        request: What was checked.
        folder: Where controllers are installed.

    Raises:
        NotAdoptedError: The weights file is not the one that was checked.
    """
    if replace(request).key != request.key:  # worked out anew
        raise NotAdoptedError(
            f"{request.weights}, which has changed since it was checked", "what was checked", "check it again"
        )
    weights = controllers.install(request.weights, folder)
    for name in packaged_tasks():
        there = demonstrations.default_root(get_task(name))
        new, old = there.with_name(f".{there.name}.new"), there.with_name(f".{there.name}.old")
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)
        shutil.copytree(request.demonstrations / there.name, new)
        if there.exists():
            there.rename(old)
        new.rename(there)
        shutil.rmtree(old, ignore_errors=True)
    controllers.make_default(weights.stem, folder)
    return weights.stem


def is_default(weights: Path) -> bool:
    """Return whether a weights file is that of the default controller.

    Raises:
        SceneError: As ``Weights``.
    """
    return Weights(weights).hash == controllers.load().hash

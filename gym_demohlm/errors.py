"""All exceptions of the project. Each says what it got, what it expected, and what to do."""

import difflib
from collections.abc import Callable, Iterable
from typing import Any


class DemoHLMError(Exception):
    """Base of all errors a user can cause; the command line turns it into one line and exit code 2.

    Args:
        got: What was found.
        expected: What should have been there.
        remedy: What the user can do.
    """

    def __init__(self, got: str, expected: str, remedy: str) -> None:
        super().__init__(f"got {got}; expected {expected}; {remedy}")
        self.got, self.expected, self.remedy = got, expected, remedy

    def __reduce__(self) -> tuple[Callable[..., "DemoHLMError"], tuple[Any, ...]]:
        """Return how pickle rebuilds the error in another process, with all three parts."""
        return _rebuild, (type(self), self.got, self.expected, self.remedy)


def _rebuild(kind: type[DemoHLMError], got: str, expected: str, remedy: str) -> DemoHLMError:
    error = kind.__new__(kind)
    DemoHLMError.__init__(error, got, expected, remedy)
    return error


class UnknownNameError(DemoHLMError):
    """A name (of a task, a region, a policy, ...) that is not registered."""

    def __init__(self, kind: str, name: object, available: Iterable[str]) -> None:
        names = sorted(available)
        close = difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)
        remedy = f"did you mean {close[0]!r}?" if close else "choose one of these"
        told = ", ".join(repr(name) if "," in name else name for name in names)
        super().__init__(f"{kind} {name!r}", f"one of {told}", remedy)


class CommandError(DemoHLMError):
    """A command to the whole-body controller with a wrong shape or values that are not finite."""


class SceneError(DemoHLMError):
    """A scene, robot description or controller that cannot be built or loaded."""


class DemonstrationError(DemoHLMError):
    """A demonstration that cannot be read, or that does not fit its task."""


class DatasetError(DemoHLMError):
    """A dataset root that exists already, is damaged, or was written by another version."""


class NoSuccessError(DatasetError):
    """A generation run that has come to its end without a success, so that there is nothing to make a dataset of."""


class PolicyError(DemoHLMError):
    """A policy checkpoint or configuration that does not fit the environment."""

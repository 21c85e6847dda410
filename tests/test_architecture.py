"""The imports of the packages: no circles, rooms in an order, and what stays out of a process until it is needed."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.helpers.paths import REPOSITORY

ORDER = {
    "gym_demohlm": (
        "errors", "files", "jsonl", "timing", "arithmetic", "poses", "robot", "task", "control", "registry",
        "variation", "scene", "simulation", "perception", "tasks", "envs", "wbc.evaluation", "wbc.training",
    ),
    "lerobot_demohlm": (
        "reproducibility", "drawing", "demonstrations", "datasets", "generation", "checks", "policies", "evaluation",
        "hardware", "teleop", "adoption", "devices", "experiments", "reports", "quickstart", "benchmarks", "cli",
    ),
}  # fmt: skip
"""Rooms of each package from the ground up: a module imports from rooms that come before its own, or from its own."""
FACADES = {
    "gym_demohlm", "gym_demohlm.furniture", "gym_demohlm.worlds", "gym_demohlm.wbc",
    "lerobot_demohlm", "lerobot_demohlm.registration",
}  # fmt: skip
"""Modules that only hand on what lies in rooms, or register it by name: they may import any of them, lazily or not."""


@dataclass(frozen=True, order=True)
class Arrow:
    """One module imports another.

    Attributes:
        source: The one that imports.
        target: The one that is imported.
        late: Whether only a function does so.
    """

    source: str
    target: str
    late: bool


def module_name(path: Path) -> str:
    """Return the name by which a file is imported."""
    words = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(words[:-1] if words[-1] == "__init__" else words)


MODULES = {
    module_name(path): path
    for package in ORDER
    for path in sorted((REPOSITORY / package).rglob("*.py"))
}  # fmt: skip


def arrows(module: str) -> Iterator[Arrow]:
    """Yield what a module imports of the packages; imports for types alone are none at run time."""

    def visit(node: ast.AST, late: bool) -> Iterator[Arrow]:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            target = name if name in MODULES else name.rpartition(".")[0]
            if target in MODULES and target != module:
                yield Arrow(module, target, late)
        late = late or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            yield from visit(child, late)

    yield from visit(ast.parse(MODULES[module].read_text()), late=False)


ARROWS = sorted({arrow for module in MODULES for arrow in arrows(module)})


def room(module: str) -> tuple[str, str] | None:
    """Return the package and room of a module; None for a facade."""
    if module in FACADES:
        return None
    package, _, rest = module.partition(".")
    for name in ORDER[package]:
        if rest == name or rest.startswith(f"{name}."):
            return package, name
    pytest.fail(f"{module} is in no room: add its room to ORDER in {Path(__file__).name}")


def height(place: tuple[str, str]) -> tuple[int, int]:
    """Return how far up a room is: all of gym_demohlm is below all of lerobot_demohlm."""
    package, name = place
    return list(ORDER).index(package), ORDER[package].index(name)


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of nodes that reach each other (Tarjan's strongly connected components), each sorted."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for target in sorted(graph.get(node, ())):
            if target not in index:
                visit(target)
                low[node] = min(low[node], low[target])
            elif target in stack:
                low[node] = min(low[node], index[target])
        if low[node] == index[node]:
            group = []
            while not group or group[-1] != node:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(sorted(group))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return found


def graph_of(chosen: list[Arrow]) -> dict[str, set[str]]:
    graph: dict[str, set[str]] = {}
    for arrow in chosen:
        graph.setdefault(arrow.source, set()).add(arrow.target)
    return graph


def test_circles_are_found() -> None:
    graph = {"a": {"b"}, "b": {"c", "d"}, "c": {"a"}, "d": {"e"}, "f": {"f2"}, "f2": {"f"}}
    assert circles(graph) == [["a", "b", "c"], ["f", "f2"]]
    assert circles({"a": {"b"}, "b": {"c"}}) == []


def test_arrows_are_found() -> None:
    assert Arrow("lerobot_demohlm.checks.doctor", "gym_demohlm.envs.rendering", True) in ARROWS
    assert Arrow("lerobot_demohlm.checks.doctor", "lerobot_demohlm.checks.portability", True) in ARROWS
    assert Arrow("lerobot_demohlm.checks.verify", "lerobot_demohlm.checks.repetition", False) in ARROWS
    assert not any(arrow.source == "gym_demohlm.errors" for arrow in ARROWS)


def test_no_module_imports_itself_by_a_detour() -> None:
    """Imports inside functions count: what is put off to hide a circle is one."""
    assert circles(graph_of([arrow for arrow in ARROWS if arrow.source not in FACADES])) == []


def test_rooms_have_an_order() -> None:
    """A module may hand work to a higher room by name (a registry, an entry point), not by an import."""
    upward = []
    for arrow in ARROWS:
        source, target = room(arrow.source), room(arrow.target)
        if source is not None and target is not None and height(target) > height(source):
            upward.append(f"{arrow.source} -> {arrow.target}{' (in a function)' if arrow.late else ''}")
    assert upward == []


def test_every_room_is_there() -> None:
    used = {place for module in MODULES if (place := room(module)) is not None}
    assert used == {(package, name) for package, names in ORDER.items() for name in names}


def loaded(code: str, names: set[str]) -> set[str]:
    """Return which of these modules are loaded in a process that runs some code."""
    code += f"\nimport sys; print(*sorted({names!r} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    return set(out.splitlines()[-1].split())


def test_environments_need_neither_torch_nor_lerobot() -> None:
    code = "import gymnasium, gym_demohlm; gymnasium.make('DemoHLM/LiftBox-v0').reset(seed=0)"
    assert loaded(code, {"torch", "lerobot", "lerobot_demohlm", "gym_demohlm.envs.env"}) == {"gym_demohlm.envs.env"}


def test_what_reads_and_verifies_datasets_needs_neither() -> None:
    code = "import lerobot_demohlm.datasets.reader, lerobot_demohlm.checks.verify, lerobot_demohlm.checks.doctor"
    assert loaded(code, {"torch", "lerobot", "gym_demohlm"}) == {"gym_demohlm"}

"""Whatever the packages import is a dependency by its own name, with bounds: nothing comes only by way of another."""

import ast
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

TOP = Path(__file__).parents[1]
PACKAGES = ("gym_demohlm", "lerobot_demohlm", "lerobot_env_demohlm")
CMEEL = {"placo": "placo", "eigenpy": "eigenpy"}
"""Modules in a prefix that ``packages_distributions`` does not see into."""
BY_HAND = {
    "atheris": {"lerobot_demohlm/benchmarks/fuzz_loaders.py"},
    "holosoma_inference": {"gym_demohlm/wbc/evaluation/peer.py"},
    "playwright": {"lerobot_demohlm/benchmarks/teleoperation.py"},
    "pyrealsense2": {"lerobot_demohlm/hardware/camera.py"},
    "onnxruntime": {"gym_demohlm/wbc/evaluation/peer.py"},
}
"""Modules that only these files import, and whose docstring or error says how to install them."""
EXTRAS = {
    "wbc": ("gym_demohlm/wbc/",),
    "ray": ("lerobot_demohlm/generation/ray_workers.py",),
    "g1": ("lerobot_demohlm/hardware/",),
}
"""Where an extra's modules may be imported."""


def imports() -> Iterator[tuple[str, str]]:
    """Yield each file with each module of others that it imports, at its top or in a function."""
    for package in PACKAGES:
        for path in sorted((TOP / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                names = []
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom):
                    assert node.level == 0, f"a relative import in {path}"
                    names = [node.module or ""]
                for name in names:
                    top = name.split(".")[0]
                    if top not in sys.stdlib_module_names and top not in PACKAGES:
                        yield path.relative_to(TOP).as_posix(), top


def declared() -> tuple[dict[str, Requirement], dict[str, dict[str, Requirement]]]:
    """Return the requirements of pyproject by canonical name: of the core, and of each extra."""
    project = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]

    def by_name(lines: list[str]) -> dict[str, Requirement]:
        found = [Requirement(line) for line in lines]
        return {canonicalize_name(entry.name): entry for entry in found}

    extras = {name: by_name(lines) for name, lines in project["optional-dependencies"].items()}
    return by_name(project["dependencies"]), extras


def test_every_import_is_declared() -> None:
    core, extras = declared()
    distributions = packages_distributions()
    missing, seen = set(), set()
    for file, module in imports():
        if file in BY_HAND.get(module, ()):
            continue
        known = {CMEEL[module]} if module in CMEEL else set(distributions.get(module, ()))
        names = {canonicalize_name(name) for name in known}
        seen |= names
        if not names:  # not installed: only an extra's module may be
            assert any(file.startswith(places) for places in EXTRAS.values()), f"{module} of {file} is not installed"
            continue
        if names & set(core):
            continue
        if not any(names & set(extras[extra]) for extra, places in EXTRAS.items() if file.startswith(places)):
            missing.add((file, module))
    assert missing == set()
    assert len(seen) > 20


def test_every_requirement_is_bounded_above() -> None:
    core, extras = declared()
    for requirements in (core, *extras.values()):
        for requirement in requirements.values():
            assert any(entry.operator in ("<", "==", "~=") for entry in requirement.specifier), str(requirement)


def test_modules_of_extras_are_explained() -> None:
    """A command that needs an extra names it: the command line knows the modules of each."""
    from lerobot_demohlm import cli

    core, extras = declared()
    distributions = packages_distributions()
    for file, module in imports():
        names = {canonicalize_name(name) for name in distributions.get(module, ())}
        for extra in extras:
            if names & set(extras[extra]) and not names & set(core):
                assert cli.EXTRAS[module] == extra, (file, module)

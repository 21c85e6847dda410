"""What decides bits: versions, the kind of processor and the code, that of tasks from outside among it."""

import importlib
import platform
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.task import Memory, Task, WideForm
from lerobot_demohlm.datasets.facts import installed_versions
from lerobot_demohlm.reproducibility import provenance


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("x86_64 AuthenticAMD avx512f", "x86_64 with FMA"),
        ("x86_64 GenuineIntel avx2", "x86_64 with FMA"),
        ("x86_64 AuthenticAMD sse4_2", "x86_64 without FMA"),
        ("x86_64 GenuineIntel", "x86_64 without FMA"),
        ("aarch64 asimd", "aarch64 with FMA"),
        ("x86_64 with FMA", "x86_64 with FMA"),
        ("x86_64 without FMA", "x86_64 without FMA"),
        ("", "unknown without FMA"),
    ],
)
def test_maker_and_vector_width_do_not_count(text: str, kind: str) -> None:
    assert provenance.kind_of_processor(text) == kind


def test_this_machine() -> None:
    now = provenance.bit_versions()
    assert now["cpu"] == provenance.cpu_family()
    assert now["cpu"].startswith(platform.machine())
    assert now.keys() == {"mujoco", "numpy", "numba", "placo", "eigenpy", "libc", "cpu"}
    assert now.items() <= installed_versions().items()
    assert provenance.bit_differences(installed_versions()) == ()


def test_differences_are_named() -> None:
    now = {"mujoco": "3.11.0", "libc": "glibc 2.36", "cpu": "x86_64 with FMA"}
    assert provenance.bit_differences(now | {"torch": "1.0"}, now) == ()
    assert provenance.bit_differences(now | {"cpu": "x86_64 AuthenticAMD avx512f"}, now) == ()
    assert provenance.bit_differences(now | {"mujoco": "3.10.0"}, now) == ("mujoco 3.10.0 then, 3.11.0 now",)
    assert provenance.bit_differences(now | {"cpu": "aarch64 asimd"}, now) == (
        "cpu aarch64 asimd then, x86_64 with FMA now",
    )
    assert provenance.bit_differences({"mujoco": "3.11.0", "cpu": "x86_64 with FMA"}, now) == (
        "libc not recorded, glibc 2.36 now",
    )


LIFT_BOX = get_task("LiftBox")
PLACES: dict[str, Callable[[Any], Task]] = {
    "build": lambda function: replace(LIFT_BOX, build=function),
    "success": lambda function: replace(LIFT_BOX, success=function),
    "a failure": lambda function: replace(LIFT_BOX, failures={"lost": function}),
    "the memory": lambda function: replace(LIFT_BOX, memory=Memory(size=1, update=function)),
    "what is drawn of it": lambda function: replace(
        LIFT_BOX, memory=Memory(size=1, update=LIFT_BOX.success, draw=function)
    ),
    "the wide form": lambda function: replace(LIFT_BOX, wide_form=WideForm(build=function, objects=LIFT_BOX.objects)),
}


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, float], ModuleType]:
    """Return a function that writes and imports a module of a name, with a number in it."""
    monkeypatch.syspath_prepend(tmp_path)

    def module(name: str, number: float) -> ModuleType:
        (tmp_path / f"{name}.py").write_text(f"LIMIT = {number}\n\ndef function(*_):\n    return LIMIT\n")
        sys.modules.pop(name, None)
        provenance._source_hash.cache_clear()
        importlib.invalidate_caches()
        return importlib.import_module(name)

    return module


def test_tasks_of_the_package_have_its_code_alone() -> None:
    for task in all_tasks().values():
        assert provenance.task_hash(task) == ""
        assert provenance.simulation_hash(task) == provenance.code_hash()


@pytest.mark.parametrize("place", PLACES)
def test_the_file_of_a_task_from_outside_counts(place: str, outside: Callable[[str, float], ModuleType]) -> None:
    """The whole file, as numbers beside a function decide what it says; its name does not, as a script has another."""
    first, copy, edited = (outside(name, number) for name, number in (("one", 0.3), ("two", 0.3), ("three", 0.4)))
    found = [PLACES[place](module.function) for module in (first, copy, edited)]
    for digest in (provenance.task_hash, provenance.simulation_hash):
        assert digest(found[0]) == digest(found[1]) != digest(found[2])
    assert provenance.code_hash() not in map(provenance.simulation_hash, found)


def test_a_process_names_the_file_that_it_has_imported(outside: Callable[[str, float], ModuleType]) -> None:
    module = outside("one", 0.3)
    task = PLACES["success"](module.function)
    before, path = provenance.task_hash(task), Path(str(module.__file__))
    path.write_text(path.read_text() + "# edited\n")
    assert provenance.task_hash(task) == before


def test_a_task_that_is_in_no_file_is_refused() -> None:
    typed: dict[str, Any] = {"__name__": "typed_in"}
    exec("def succeeds(sim):\n    return sim.time > 0.3", typed)
    with pytest.raises(DatasetError, match=r"a function in 'typed_in', which has no file.*write the task into a file"):
        provenance.task_hash(PLACES["success"](typed["succeeds"]))

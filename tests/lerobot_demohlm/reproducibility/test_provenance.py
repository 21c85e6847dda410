"""What decides bits: versions and the kind of processor, read from new records and old ones."""

import platform

import pytest

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

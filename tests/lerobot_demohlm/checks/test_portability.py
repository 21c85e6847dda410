"""One machine stands in for many: NumPy and OpenBLAS choose other code, and every bit stays what it is."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numpy._core._multiarray_umath import __cpu_features__ as cpu_features  # pyright: ignore

from gym_demohlm.registry import get_task
from lerobot_demohlm.checks import portability

_AVX512 = " ".join(name for name, there in cpu_features.items() if there and name.startswith("AVX512"))
_LESS = {
    "no_avx512": {"NPY_DISABLE_CPU_FEATURES": _AVX512},
    "no_avx2": {"NPY_DISABLE_CPU_FEATURES": f"{_AVX512} AVX2 FMA3".strip()},
}
_CORES = {"haswell": {"OPENBLAS_CORETYPE": "Haswell"}, "zen": {"OPENBLAS_CORETYPE": "Zen"}}
if cpu_features["AVX512_SKX"]:
    _CORES["skylakex"] = {"OPENBLAS_CORETYPE": "SkylakeX"}
if not _AVX512:
    del _LESS["no_avx512"]
_CODE = "import json; from lerobot_demohlm import portability; print(json.dumps(portability.parts()))"

same_versions = pytest.mark.skipif(
    bool(portability.differing_versions()), reason="other libraries than the packaged digests have: bits may differ"
)


@pytest.fixture(scope="module")
def here() -> dict[str, str]:
    return portability.parts()


@pytest.mark.parametrize("environment", [*_CORES, *_LESS])
def test_other_code_paths_give_the_same_bits(environment: str, here: dict[str, str]) -> None:
    changed = os.environ | {**_CORES, **_LESS}[environment]
    out = subprocess.run([sys.executable, "-c", _CODE], env=changed, capture_output=True, text=True, check=True).stdout
    assert json.loads(out.splitlines()[-1]) == here


@same_versions
def test_bits_are_the_packaged_ones(here: dict[str, str]) -> None:
    assert here == portability.packaged()["parts"]


@same_versions
@pytest.mark.parametrize("name", portability.packaged()["tasks"])
def test_behaviour_is_the_packaged_one(name: str) -> None:
    """Where this fails for a change on purpose, results are of an earlier version: write the digests again."""
    assert portability.behaviour(get_task(name)) == portability.packaged()["tasks"][name]


def test_a_digest_changes_with_one_bit(monkeypatch: pytest.MonkeyPatch, here: dict[str, str]) -> None:
    made = portability.WholeBodyController.step

    def nudged(self: portability.WholeBodyController, *arguments: np.ndarray) -> np.ndarray:
        targets = made(self, *arguments)
        targets[0, 0] = np.nextafter(targets[0, 0], 9.0)
        return targets

    monkeypatch.setattr(portability.WholeBodyController, "step", nudged)
    parts = portability.parts()
    assert parts["controller"] != here["controller"]
    assert parts["physics"] != here["physics"]
    assert parts["inverse kinematics"] == here["inverse kinematics"]


def test_other_versions_are_named() -> None:
    now = portability.versions()
    assert portability.compare_versions(now, now) == ()
    (line,) = portability.compare_versions({**now, "mujoco": "3.10.0"}, now)
    assert line == f"mujoco 3.10.0 then, {now['mujoco']} now"

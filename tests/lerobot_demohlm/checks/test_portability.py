"""One machine stands in for many: NumPy and OpenBLAS choose other code, and every bit stays what it is."""

import json
import os
import subprocess
import sys
from pathlib import Path

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
_COMPILED = {
    "compiled_for_haswell": {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""},
    "compiled_for_any": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
}
_ENVIRONMENTS = [
    pytest.param(environment, id=name, marks=pytest.mark.slow if name in ("zen", "compiled_for_haswell") else ())
    for name, environment in {**_CORES, **_LESS, **_COMPILED}.items()
]
_CODE = "import json; from lerobot_demohlm.checks import portability; print(json.dumps(portability.parts()))"
_PATHS = """
import hashlib
import numpy as np
from gym_demohlm import poses
from lerobot_demohlm.teleop.path import HandPath, Waypoint

rng = np.random.default_rng(0)
start, *ends = poses.from_rotation(poses.rotation_from_rpy(rng.uniform(-1, 1, (99, 2, 3))), rng.normal(size=(99, 2, 3)))
path = HandPath(start, [Waypoint(T_world_hands=end, duration_s=rng.uniform(0.3, 9), grippers=0.0) for end in ends])
print(hashlib.sha256(path.T_world_hands.tobytes()).hexdigest())
"""

same_versions = pytest.mark.skipif(
    bool(portability.differing_versions()), reason="other libraries than the packaged digests have: bits may differ"
)


@pytest.fixture(scope="module")
def here() -> dict[str, str]:
    return portability.parts()


@pytest.mark.parametrize("environment", _ENVIRONMENTS)
def test_other_code_paths_give_the_same_bits(environment: dict[str, str], here: dict[str, str]) -> None:
    changed = os.environ | environment
    out = subprocess.run([sys.executable, "-c", _CODE], env=changed, capture_output=True, text=True, check=True).stdout
    assert json.loads(out.splitlines()[-1]) == here


def test_other_code_paths_give_scripts_the_same_hand_targets() -> None:
    outs = {
        subprocess.run([sys.executable, "-c", _PATHS], env=os.environ | changed, capture_output=True, check=True).stdout
        for changed in ({}, *_CORES.values(), *_LESS.values())
    }
    assert len(outs) == 1


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


def test_old_digests_name_the_architecture_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = json.loads(portability.PACKAGED.read_text())
    content["versions"] = {name: value for name, value in content["versions"].items() if name != "cpu"}
    content["versions"]["machine"] = "riscv64"
    (tmp_path / "digests.json").write_text(json.dumps(content))
    monkeypatch.setattr(portability, "PACKAGED", tmp_path / "digests.json")
    assert portability.packaged()["versions"]["cpu"] == "riscv64 with FMA"
    assert any(line.startswith("cpu riscv64 with FMA then") for line in portability.differing_versions())

"""Compiled kernels against the NumPy functions that they stand for: equal bit for bit, whatever robots do."""

import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_demohlm import arithmetic
from gym_demohlm.arithmetic import elu
from gym_demohlm.control import command, controllers, features
from gym_demohlm.control.kernels import compiler
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.settings import Gait, Settings, Trim
from gym_demohlm.control.tick import Sensors, Tick
from gym_demohlm.control.velocity_map import NUM_TERMS
from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, WholeBodyController
from gym_demohlm.robot import g1
from tests.helpers.gaits import GAITS

_JOINTS = len(g1.BODY_JOINTS)
_CONTROLLERS: dict[int, WholeBodyController] = {}


def _controller(num_worlds: int, how: Settings) -> WholeBodyController:
    """Return a controller with other settings; its weights are read once."""
    controller = _CONTROLLERS.setdefault(num_worlds, WholeBodyController(num_worlds))
    controller.settings = replace(how, physics=controller.physics)
    return controller


def _sensed(rng: np.random.Generator, count: int, wild: float) -> Proprioception:
    """Return proprioception of robots about their home pose; of robots that do not move at all for ``wild`` of 0."""
    quat_wxyz = np.array([1.0, 0.0, 0.0, 0.0]) + 0.4 * wild * rng.uniform(-1, 1, (count, 4))
    quat_wxyz /= np.sqrt((quat_wxyz**2).sum(axis=1, keepdims=True))
    return Proprioception(
        quat_wxyz=quat_wxyz,
        gyro=3.0 * wild * rng.uniform(-1, 1, (count, 3)),
        q=g1.HOME + wild * rng.uniform(-1, 1, (count, _JOINTS)),
        dq=5.0 * wild * rng.uniform(-1, 1, (count, _JOINTS)),
    )


def _policy(controller: WholeBodyController, observed: np.ndarray) -> np.ndarray:
    """Return the mean action of robots, and of their mirror if it is symmetric, by the functions of arrays."""
    weights, inputs = controller.weights, len(controller.weights.mean)
    latent = (observed[:, :inputs] - weights.mean) * weights.scale
    mirror = features.first_inputs(features.OBSERVATION_MIRROR, inputs)
    hidden = np.concatenate([latent, features.mirror(latent, mirror)])
    for product, bias in weights.layers[:-1]:
        hidden = elu(product(hidden) + bias)
    product, bias = weights.layers[-1]
    seen, in_mirror = np.split(product(hidden) + bias, 2)
    action = 0.5 * (seen + features.mirror(in_mirror, features.ACTION_MIRROR)) if weights.symmetric else seen
    return np.clip(action, -features.ACTION_LIMIT, features.ACTION_LIMIT)


def _in_numpy(controller: WholeBodyController, sensed: Proprioception, commands: np.ndarray) -> np.ndarray:
    """Return what ``controller.step`` is to return, and move its state, by the NumPy functions."""
    tick = Tick(controller.reference, controller.settings)
    arms = commands[:, command.ARMS]
    situation = tick.perceive(controller.state, Sensors.of(sensed), commands, arms[:, features.OBSERVED_ARM_INDEX])
    action = _policy(controller, situation.observation())
    controller.state = situation.remember(action)
    ranges = g1.joint_ranges(g1.read_mjcf())[features.ACTION_SIZE :]
    return np.concatenate([tick.targets(situation, action), np.clip(arms, ranges[:, 0], ranges[:, 1])], axis=1)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_worlds=st.sampled_from([1, 2, 3, 8]),
    gait=st.sampled_from(sorted(GAITS)),
    wild=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    walks=st.booleans(),
    gain=st.sampled_from([1.0, 1.2]),
    rate=st.sampled_from([0.0, 0.7]),
    mapped=st.booleans(),
)
def test_a_tick_has_the_bits_of_numpy(
    seed: int, num_worlds: int, gait: str, wild: float, walks: bool, gain: float, rate: float, mapped: bool
) -> None:
    rng = np.random.default_rng(seed)
    rows = tuple(map(tuple, rng.normal(scale=0.03, size=(2 if mapped else 0, NUM_TERMS)).tolist()))
    how = Settings(gait=GAITS[gait], gain=(gain,) * 7, velocity_map=rows, trim=Trim(rate=rate))
    controller = _controller(num_worlds, how)
    sensed = _sensed(rng, num_worlds, wild)
    controller.reset(np.arange(num_worlds), sensed)
    commands = command.LOWER + rng.random((num_worlds, command.SIZE)) * (command.UPPER - command.LOWER)
    if walks:
        commands[:, command.TORSO] = command.rest()[command.TORSO]
    else:
        commands[:, command.VELOCITY] = 0.0
    for _ in range(12):
        sensed, before = _sensed(rng, num_worlds, wild), controller.state.copy()
        expected, after = _in_numpy(controller, sensed, commands), controller.state
        controller.state = before.copy()
        assert controller.step(sensed, commands).tobytes() == expected.tobytes()
        assert controller.state.tobytes() == after.tobytes()


@pytest.mark.parametrize("without", ["symmetric", "use_reference"])
def test_a_policy_runs_as_it_was_trained(tmp_path: Path, without: str) -> None:
    """Without its mirror image it acts otherwise, without the reference it corrects another pose."""
    controllers.rewrite(DEFAULT_WEIGHTS, tmp_path / "without.npz", **{without: False})
    usual, controller = (WholeBodyController(3, path) for path in (None, tmp_path / "without.npz"))
    rng = np.random.default_rng(0)
    sensed, commands = _sensed(rng, 3, 0.2), np.tile(command.rest(), (3, 1))
    commands[:, command.VELOCITY] = [0.5, 0.2, 0.5]
    for each in (usual, controller):
        each.reset(np.arange(3), sensed)
    other = usual.step(sensed, commands)[:, : features.ACTION_SIZE]
    before = controller.state.copy()
    expected, after = _in_numpy(controller, sensed, commands), controller.state
    controller.state = before
    targets = controller.step(sensed, commands)
    assert targets.tobytes() == expected.tobytes() and controller.state.tobytes() == after.tobytes()
    assert np.abs(targets[:, : features.ACTION_SIZE] - other).max() > 0.01


def test_a_world_has_the_same_bits_alone_and_among_others() -> None:
    rng, count = np.random.default_rng(0), 7
    controller = _controller(count, Settings(gait=Gait(capture=(0.1, 0.1, 0.1))))
    sensed, commands = _sensed(rng, count, 0.5), command.LOWER + rng.random((count, command.SIZE))
    controller.reset(np.arange(count), sensed)
    commands = np.clip(commands, command.LOWER, command.UPPER)
    before = controller.state.copy()
    together = controller.step(sensed, commands)
    after, controller.state = controller.state, before.copy()
    for world in range(count):
        row = np.array([world])
        alone = controller.step(sensed[row], commands[row], row)
        assert alone.tobytes() == together[row].tobytes()
    assert controller.state.tobytes() == after.tobytes()


def _half(x: float) -> float:
    return x / 2


def test_kernels_are_compiled_anew_where_no_cache_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = numba.njit

    def without_cache(function: object, cache: bool = False, **options: object) -> object:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return plain(function, **options)

    monkeypatch.setattr(compiler.numba, "njit", without_cache)
    assert compiler.compiled(_half)(3.0) == 1.5


def test_kernels_of_other_sources_or_constants_have_other_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Numba looks for changes in one file only, and a kernel is made of many."""
    module, file = types.ModuleType("made_up.part"), tmp_path / "part.py"
    module.__file__, module.__dict__["_LENGTH"] = str(file), np.array([0.1, 0.2])
    monkeypatch.setitem(sys.modules, "made_up.part", module)
    file.write_text("a = 1")
    first = compiler.digest("made_up")
    assert first == compiler.digest("made_up") != compiler.digest()
    file.write_text("a = 2")
    second = compiler.digest("made_up")
    module.__dict__["_LENGTH"] = np.array([0.1, 0.3])
    assert len({first, second, compiler.digest("made_up")}) == 3


def test_kernels_of_another_arithmetic_have_other_names(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The policy's activation is a function of it, compiled into a kernel."""
    first, file = compiler.digest(), tmp_path / "arithmetic.py"
    file.write_text("a = 1")
    monkeypatch.setattr(arithmetic, "__file__", str(file))
    assert compiler.digest() != first


def test_kernels_never_fuse_a_product_and_a_sum() -> None:
    """On processors with fused multiply-add the one rounding less would make other bits than on those without."""
    a = 1.0 + 2.0**-30

    @compiler.inlined
    def fused(x: float, y: float, z: float) -> float:
        return x * y + z

    assert fused(a, a, -1.0) == a * a - 1.0


@pytest.mark.slow
def test_a_second_process_finds_the_kernels_compiled(tmp_path: Path) -> None:
    """It loads them in a small part of the time that compiling took; both are CPU time of one machine."""
    program = (
        "import time, numpy as np\n"
        "from gym_demohlm.registry import get_task\n"
        "from gym_demohlm.simulation import Simulation\n"
        "sim = Simulation(get_task('LiftBox')); began = time.process_time(); sim.step(sim.command)\n"
        "print(time.process_time() - began)\n"
    )
    seconds = [
        float(
            subprocess.run(
                [sys.executable, "-c", program],
                env={"NUMBA_CACHE_DIR": str(tmp_path), "PATH": ""},
                capture_output=True,
                text=True,
                check=True,
            ).stdout
        )
        for _ in range(2)
    ]
    assert seconds[1] < 0.2 * seconds[0]

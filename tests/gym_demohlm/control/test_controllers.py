"""Weights files: settings are read from them, bad ones are refused, several are installed side by side."""

import hashlib
import json
import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_demohlm.control import command, controllers, features
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.settings import Gait, Settings, Trim, read_gait
from gym_demohlm.control.tick import Sensors, Tick
from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, WEIGHTS_FOLDER, Weights, WholeBodyController
from gym_demohlm.errors import DemoHLMError, SceneError, UnknownNameError
from gym_demohlm.robot import g1
from gym_demohlm.robot.physics import PHYSICS, SECOND
from gym_demohlm.simulation import Simulation
from gym_demohlm.wbc.evaluation.trial import trial_task

Arrays = dict[str, np.ndarray]
FIRST_WEIGHTS = WEIGHTS_FOLDER / "8ac4c8cd0008.npz"


def _write(path: Path, change: Callable[[Arrays, dict], None], weights: Path = DEFAULT_WEIGHTS) -> Path:
    """Write packaged weights, their arrays and metadata changed."""
    with np.load(weights) as file:
        arrays = dict(file)
    metadata = json.loads(arrays["metadata"].tobytes())
    change(arrays, metadata)
    arrays["metadata"] = np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)
    np.savez(path, allow_pickle=True, **arrays)  # type: ignore[arg-type]
    return path


def test_settings_survive_a_file(tmp_path: Path) -> None:
    settings = Settings(
        gait=Gait(period_s=0.6, spread=0.08, turn=tuple(0.01 * np.arange(12)), capture=(0.1, 0.09, 0.12)),
        slew=(1.0, 1.5, 3.0, 0.4, 1.2, 1.2, 1.5),
        gain=(1.1, 1.3, 1.0, 1.0, 1.0, 1.0, 1.0),
        trim=Trim(rate=0.5),
        physics=SECOND,
        damping=tuple(2.0 * g1.motor(joint).damping for joint in g1.BODY_JOINTS),
    )
    path = _write(tmp_path / "w.npz", lambda _, metadata: metadata.update(settings.metadata()))
    assert Weights(path).settings == settings
    controller = WholeBodyController(1, path)
    assert controller.cycle_s == 0.6
    simulation = Simulation(trial_task(), controller=controller)
    assert simulation.model.opt.noslip_iterations == SECOND.noslip_iterations
    for model in (simulation.model, simulation.scene.physics, simulation.scene.untouched):
        assert model.actuator("left_knee").biasprm[2] == -2.0 * g1.motor("left_knee").damping


@pytest.mark.parametrize("content", ["[]", "3", "null"])
def test_a_gait_that_is_no_object_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "gait.json"
    path.write_text(content)
    with pytest.raises(SceneError, match="a JSON object"):
        read_gait(path)


def test_the_first_weights_have_the_first_settings() -> None:
    assert Weights(FIRST_WEIGHTS).settings == Settings()


def test_a_robot_of_other_settings_moves_otherwise(tmp_path: Path) -> None:
    slow = Settings(slew=tuple(0.5 * rate for rate in Settings().slew))
    path = _write(tmp_path / "w.npz", lambda _, metadata: metadata.update(slow.metadata()))
    told = np.zeros((1, 23))
    told[0, 3], told[0, 7:21] = 0.6, g1.HOME[15:]
    slewed = []
    for weights in (None, path):
        controller = WholeBodyController(1, weights)
        upright = np.array([[1.0, 0, 0, 0]])
        still = Proprioception(quat_wxyz=upright, gyro=np.zeros((1, 3)), q=g1.HOME[None], dq=np.zeros((1, 29)))
        controller.reset(np.arange(1), still)
        controller.step(still, told)
        slewed.append(g1.PELVIS_HEIGHT - controller.slewed[0, 3])
    assert slewed[1] == pytest.approx(0.5 * slewed[0])


def _poison(arrays: Arrays, _: dict) -> None:
    arrays["weight_1"][3, 3] = np.nan


def _of_objects(arrays: Arrays, _: dict) -> None:
    arrays["bias_0"] = np.array([{"a": 1}], dtype=object)


def _narrower(arrays: Arrays, _: dict) -> None:
    arrays["weight_1"] = arrays["weight_1"][:, :-1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_poison, "NaN or infinity in weight_1"),
        (_of_objects, "cannot be read"),
        (_narrower, "layers that fit"),
        (lambda arrays, _: arrays.pop("bias_1"), "cannot be read"),
        (lambda _, metadata: metadata.update(format=9), "format 9"),
        (lambda _, metadata: metadata.update(gait={"hop": 1.0}), "hop"),
        (lambda _, metadata: metadata.update(gait={"period_s": "long"}), "a finite number"),
        (lambda _, metadata: metadata.update(gait={"swing": 0.7}), "swing 0.7"),
        (lambda _, metadata: metadata.update(slew=[1.0]), "slew"),
        (lambda _, metadata: metadata.update(stiffness={"left_knee": float("nan")}), "finite"),
    ],
)
def test_bad_weights_are_a_clear_error(tmp_path: Path, change: Callable[[Arrays, dict], None], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        Weights(_write(tmp_path / "w.npz", change))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_truncated_weights_are_a_clear_error(tmp_path: Path, share: float) -> None:
    whole = DEFAULT_WEIGHTS.read_bytes()
    path = tmp_path / "w.npz"
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(SceneError, match="cannot be read"):
        Weights(path)


def test_a_pickle_is_refused_unread(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple:
            return (Path.touch, (tmp_path / "executed",))

    path = tmp_path / "w.npz"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(SceneError, match="cannot be read"):
        Weights(path)
    assert not (tmp_path / "executed").exists()


def test_controllers_are_found_by_name_path_and_hash(tmp_path: Path) -> None:
    folder = tmp_path / "weights"
    folder.mkdir()
    first = controllers.install(DEFAULT_WEIGHTS, folder)
    (folder / "default.txt").write_text(first.stem)
    other = _write(
        tmp_path / "other.npz", lambda _, metadata: metadata.update(Settings(trim=Trim(rate=0.6)).metadata())
    )
    there = controllers.install(other, folder)
    digest = hashlib.sha256(other.read_bytes()).hexdigest()
    assert [(entry.name, entry.is_default) for entry in controllers.installed(folder)] == [
        (DEFAULT_WEIGHTS.stem, True),
        (digest[:12], False),
    ]
    assert controllers.find("default", folder) == first
    for wanted in (digest, digest[:8].upper(), digest[:12]):
        assert controllers.find(wanted, folder) == there
    assert controllers.find(str(other), folder) == other
    assert Weights(there).hash == digest
    for wanted in ("nobody", digest[:7]):
        with pytest.raises(UnknownNameError, match=digest[:12]):
            controllers.find(wanted, folder)
    with pytest.raises(SceneError, match="no file"):
        controllers.find(str(tmp_path / "missing.npz"), folder)
    controllers.make_default(digest[:12], folder)
    assert controllers.find("default", folder) == there


def test_every_installed_controller_is_named_by_its_hash_and_can_be_used() -> None:
    there = controllers.installed()
    assert sum(controller.is_default for controller in there) == 1
    for controller in there:
        assert controller.name == controller.hash[: controllers.HASH_DIGITS]
        assert controllers.recorded(controller.hash) == controller.name
        simulation = Simulation(trial_task(), controller=controller.name)
        physics = Weights(controller.path).settings.physics
        assert simulation.model.opt.noslip_iterations == physics.noslip_iterations
        simulation.close()
    assert controllers.recorded("0" * 64) is None


def test_scenes_without_a_controller_have_the_physics_of_the_default_one() -> None:
    assert controllers.load().settings.physics == PHYSICS


def test_a_gain_tells_the_policy_more_than_was_commanded(tmp_path: Path) -> None:
    gain = (1.2, 1.4, 1.0, 1.1, 1.0, 1.0, 1.0)
    path = _write(tmp_path / "w.npz", lambda _, metadata: metadata.update(gain=gain), FIRST_WEIGHTS)
    told = np.tile(command.rest(), (1, 1))
    told[0, :4] = 0.3, -0.2, 0.5, 0.7
    situations = []
    for weights in (FIRST_WEIGHTS, path):
        controller = WholeBodyController(1, weights)
        tick = Tick(controller.reference, controller.settings)
        still = Proprioception(
            quat_wxyz=np.array([[1.0, 0, 0, 0]]), gyro=np.zeros((1, 3)), q=g1.HOME[None], dq=np.zeros((1, 29))
        )
        controller.reset(np.arange(1), still)
        arms = told[:, command.ARMS][:, features.OBSERVED_ARM_INDEX]
        situations.append(tick.perceive(controller.state, Sensors.of(still), told, arms))
    plain, led = situations
    assert np.array_equal(plain.slewed, led.slewed)
    np.testing.assert_allclose(led.told[0, :2], np.multiply(plain.told[0, :2], gain[:2]))
    drop = g1.PELVIS_HEIGHT - plain.told[0, 3]
    assert drop > 0
    np.testing.assert_allclose(g1.PELVIS_HEIGHT - led.told[0, 3], 1.1 * drop)


def test_bad_weights_are_not_installed(tmp_path: Path) -> None:
    path = _write(tmp_path / "w.npz", _poison)
    with pytest.raises(DemoHLMError):
        controllers.install(path, tmp_path / "none")


def test_every_installed_controller_can_be_used() -> None:
    for entry in controllers.installed():
        weights = Weights(entry.path)
        assert weights.hash == entry.hash
        assert entry.hash.startswith(entry.name)
        assert type(weights.settings).read(weights.settings.metadata()) == weights.settings


def test_a_tuned_controller_has_another_gait_and_the_same_network(tmp_path: Path) -> None:
    path = tmp_path / "tuned.npz"
    controllers.tune(DEFAULT_WEIGHTS, path, {"recovery_s": 7.5, "capture": [0.1, 0.09, 0.12]})
    old, new = Weights(DEFAULT_WEIGHTS), Weights(path)
    expected = replace(old.settings.gait, recovery_s=7.5, capture=(0.1, 0.09, 0.12))
    assert new.settings == replace(old.settings, gait=expected)
    assert new.hash != old.hash
    with np.load(DEFAULT_WEIGHTS) as before, np.load(path) as after:
        assert before.files == after.files
        for name in before.files:
            assert name == "metadata" or np.array_equal(before[name], after[name])
    again = tmp_path / "again.npz"
    controllers.tune(DEFAULT_WEIGHTS, again, {"recovery_s": 7.5, "capture": [0.1, 0.09, 0.12]})
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    "gait",
    [
        *(
            {"recovery": 4.0},
            {"period_s": 0.05},
            {"recovery_s": -1.0},
            {"lift": None},
            {"lift": "abc"},
            {"sway": math.nan},
        ),
        *({"capture": [0.1]}, {"capture": 0.1}, {"placement_s": [1, 2]}, {"turn": ["a"] * 12}, {"sway": True}),
    ],
)
def test_a_gait_that_is_none_is_refused_and_nothing_is_written(gait: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises((SceneError, UnknownNameError)):
        controllers.tune(DEFAULT_WEIGHTS, tmp_path / "tuned.npz", gait)
    assert not list(tmp_path.iterdir())

"""What disturbs a robot's senses: numbers that follow from the world's seed and the tick, and from nothing else."""

import numpy as np

from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.disturbances import Disturbances
from gym_demohlm.variation import Conditions, get_variation
from gym_demohlm.variation.conditions import SEED

JOINTS = len(g1.BODY_JOINTS)


def drawn(num_worlds: int) -> list[Conditions]:
    """Return the conditions of some worlds under `hard`; the last one has none of them."""
    sim = Simulation(get_task("PressCube"), variation=get_variation("hard:robot"))
    starts = [{"robot": [-0.3, 0.01 * index, 0.0], "object": [0.0, 0.0, 0.0]} for index in range(num_worlds - 1)]
    found = [Conditions.read(sim.vary(start)) for start in starts]
    sim.close()
    return [*found, Conditions()]


def test_noise_is_that_of_numpys_counter_based_generator_for_seed_and_tick() -> None:
    """The bits of datasets depend on it."""
    conditions, rng = drawn(4), np.random.default_rng(0)
    disturbances = Disturbances(4)
    for world, found in enumerate(conditions):
        disturbances.reset(world, found)
    worlds, ticks = np.array([3, 1, 2]), np.array([5, 70_000, 0])
    quat = rng.normal(size=(3, 4))
    truth = Proprioception(
        quat_wxyz=quat / np.linalg.norm(quat, axis=1, keepdims=True),
        gyro=rng.normal(size=(3, 3)),
        q=rng.normal(size=(3, JOINTS)),
        dq=rng.normal(size=(3, JOINTS)),
    )
    sensed = disturbances.sense(truth, worlds, ticks)
    for row, (world, tick) in enumerate(zip(worlds, ticks, strict=True)):
        found = conditions[world]
        seed = int((found.values.get(SEED) or (0.0,))[0])

        def uniform(counter: int, count: int, seed: int = seed) -> np.ndarray:
            generator = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, counter]))
            return 2.0 * generator.random(count) - 1.0

        noise = uniform(int(tick), 2 * JOINTS + 5)
        bias = found.number("robot.encoder_bias", plain=0.0) * uniform(2**40, JOINTS)
        q = truth.q[row] + bias + found.number("robot.encoder", plain=0.0) * noise[:JOINTS]
        dq = truth.dq[row] + found.number("robot.speed", plain=0.0) * noise[JOINTS : 2 * JOINTS]
        gyro = truth.gyro[row] + found.number("robot.gyro", plain=0.0) * noise[-5:-2]
        for name, expected in (("q", q), ("dq", dq), ("gyro", gyro)):
            np.testing.assert_array_equal(getattr(sensed, name)[row], expected, err_msg=name)
        tilt = 2.0 * np.arccos(min(1.0, abs(float(sensed.quat_wxyz[row] @ truth.quat_wxyz[row]))))
        most = found.number("robot.gravity", plain=0.0)
        assert tilt <= 1.01 * np.sqrt(2.0) * most and (tilt > 0.0) == (most > 0.0)


def test_a_world_senses_the_same_alone_and_among_others() -> None:
    conditions, disturbances = drawn(4), Disturbances(4)
    for world, found in enumerate(conditions):
        disturbances.reset(world, found)
    rng, worlds, ticks = np.random.default_rng(1), np.arange(4), np.array([3, 4, 5, 6])
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    truth = [quat, *(rng.normal(size=(4, size)) for size in (3, JOINTS, JOINTS))]
    names = ("quat_wxyz", "gyro", "q", "dq")
    together = disturbances.sense(Proprioception(**dict(zip(names, truth, strict=True))), worlds, ticks)
    for world in worlds:
        one = Proprioception(**{name: each[[world]] for name, each in zip(names, truth, strict=True)})
        alone = disturbances.sense(one, worlds[[world]], ticks[[world]])
        for name in names:
            assert getattr(alone, name).tobytes() == getattr(together, name)[[world]].tobytes()

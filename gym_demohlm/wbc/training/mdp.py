"""The Markov decision process of the whole-body controller: N training worlds on a CPU or a GPU, all else in NumPy.

Joint targets = reference(command, clock) + scale * action. Actions are 15 numbers at 50 Hz; arms follow random targets.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from gym_demohlm.control import attitude, features, odometry, reference
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT
from gym_demohlm.wbc.training import rewards
from gym_demohlm.wbc.training.commands import CommandSampler
from gym_demohlm.wbc.training.model import SUBSTEPS, training_model
from gym_demohlm.wbc.training.physics import STATE, make_physics
from gym_demohlm.wbc.training.quasi_static import tables

_JOINTS = len(features.OBSERVED_JOINTS)
_PRIVILEGED = 10  # base velocity 3, foot contact 2, foot height 2, base height 1, torso pitch and roll 2
_AVERAGED_S = 0.6  # s: time constant of the averaged velocity error, about a gait period
_LEGS = len(g1.LEG_JOINTS)
_ODOMETRY_NOISE = 0.03  # m/s
CRITIC_SIZE = features.OBSERVATION_SIZE + _PRIVILEGED
_NOISE = np.concatenate([np.full(3, 0.05), np.full(3, 0.03), np.full(_JOINTS, 0.01), np.full(_JOINTS, 0.05)])


def _critic_mirror() -> tuple[np.ndarray, np.ndarray]:
    source, sign = features.OBSERVATION_MIRROR
    extra = len(source) + np.array([0, 1, 2, 4, 3, 6, 5, 7, 8, 9])
    return np.concatenate([source, extra]), np.concatenate([sign, [1, -1, 1, 1, 1, 1, 1, 1, 1, -1]]).astype(np.float32)


CRITIC_MIRROR = _critic_mirror()


@dataclass(frozen=True, kw_only=True)
class MdpConfig:
    """Size and difficulty of the training worlds.

    Attributes:
        num_worlds: Worlds stepped together.
        num_variants: Randomised models shared among them.
        num_threads: Threads of mujoco.rollout.
        warp_device: Where mujoco_warp runs the physics (``cuda``, ``cpu``); with None it is mujoco.rollout.
        episode_ticks: Length of an episode [control ticks].
        push_speed: Largest sudden change of the base's horizontal velocity [m/s].
        push_probability: Chance of a push a tick, in the worlds that are pushed.
        pushed_share: Share of the worlds that are pushed; the others learn to be accurate.
        largest_delay: Substeps until new targets reach the motors, at most (of 5 ms; drawn for every episode).
        use_reference: Whether actions correct the reference pose; without it they correct the pose of rest.
        seed: Of everything random.
    """

    num_worlds: int = 256
    num_variants: int = 32
    num_threads: int = 1
    warp_device: str | None = None
    episode_ticks: int = 1000
    push_speed: float = 0.6
    push_probability: float = 0.006
    pushed_share: float = 0.4
    largest_delay: int = 4
    use_reference: bool = True
    seed: int = 1


class _Rest(reference.Reference):
    """The pose of rest whatever the command: training without a reference, to see what the reference is worth."""

    def pose(
        self, command: np.ndarray, phase: np.ndarray, standing: np.ndarray, velocity: np.ndarray, moment: np.ndarray
    ) -> np.ndarray:
        return np.tile(g1.HOME[: reference.NUM_LOWER], (len(command), 1))

    def sag(self, command: np.ndarray, phase: np.ndarray, standing: np.ndarray, moment: np.ndarray) -> np.ndarray:
        return np.zeros((len(command), reference.NUM_LOWER))


class WholeBodyMdp:
    """N robots learning to follow commands.

    Attributes:
        level: Curriculum in [0, 1]: widens the command ranges and the arms' motion.
        push_level: Curriculum in [0, 1]: strengthens the pushes.
        pushed: (N,) bool, the worlds that are pushed.
    """

    def __init__(self, config: MdpConfig) -> None:
        self.config = config
        self.rng = np.random.default_rng(config.seed)
        n = config.num_worlds
        variants = [training_model(self.rng) for _ in range(config.num_variants)]
        self.model = variants[0]
        self._physics = make_physics(
            variants, n, SUBSTEPS, num_threads=config.num_threads, warp_device=config.warp_device
        )
        self._state = np.zeros((n, mujoco.mj_stateSize(self.model, STATE)))
        self._address = {
            self.model.sensor(i).name: slice(
                self.model.sensor_adr[i], self.model.sensor_adr[i] + self.model.sensor_dim[i]
            )
            for i in range(self.model.nsensor)
        }
        joints = [self.model.joint(f"{joint}_joint") for joint in features.OBSERVED_JOINTS]
        ranges = np.array([joint.range for joint in joints])
        self._lower, self._upper = ranges[:, 0], ranges[:, 1]
        self.reference = (reference.Reference if config.use_reference else _Rest)(*tables())
        self.commands = CommandSampler(n, self.rng)
        self.level = self.push_level = 0.0
        self.pushed = np.arange(n) < round(config.pushed_share * n)
        self.phase, self.stopped, self.standing = np.zeros(n), np.zeros(n), np.ones(n, dtype=bool)
        self.action, self.previous_action = np.zeros((n, features.ACTION_SIZE)), np.zeros((n, features.ACTION_SIZE))
        self.history = np.zeros((n, features.HISTORY, features.FRAME_SIZE))
        self.privileged = np.zeros((n, _PRIVILEGED))
        self._mean_error = np.zeros((n, 3))
        self.velocity, self.startled = np.zeros((n, 2)), np.zeros(n, dtype=bool)
        self.carried = np.zeros((n, 2))
        self._delay, self._targets = np.zeros(n, dtype=int), np.zeros((n, _JOINTS))
        self.ticks = np.zeros(n, dtype=int)
        self.tracking: dict[str, float] = {}
        self.terms: dict[str, float] = {}
        self.reset(np.arange(n))

    @property
    def qpos(self) -> np.ndarray:
        """Positions, (N, 7 + 23): a view of the state."""
        return self._state[:, 1 : 8 + _JOINTS]

    @property
    def qvel(self) -> np.ndarray:
        """Velocities, (N, 6 + 23): a view of the state."""
        return self._state[:, 8 + _JOINTS : 14 + 2 * _JOINTS]

    def reset(self, worlds: np.ndarray) -> None:
        """Start new episodes near the reference pose of a new command."""
        if len(worlds) == 0:
            return
        count = len(worlds)
        self.commands.reset(worlds, self.level)
        command = self.commands.current[worlds]
        walk = (np.abs(self.commands.goal[worlds, :3]) > reference.WALK_THRESHOLD).any(axis=1)
        self.phase[worlds] = self.rng.choice(reference.REST_PHASES, count)
        self.stopped[worlds] = np.where(walk, 0.0, 2.0)
        self.standing[worlds] = ~walk
        moment = self.reference.arms_moment(command, self.commands.arms[worlds], np.zeros((count, 2)))
        at_rest = np.ones(count, dtype=bool), np.zeros((count, 2))
        targets = self.reference.pose(command, self.phase[worlds], *at_rest, moment)
        lean, _ = attitude.lean(command[:, 4], command[:, 5], command[:, 6])
        _, tilt, _ = self.reference.statics(command[:, 3], lean)
        qpos = np.zeros((count, 7 + _JOINTS))
        qpos[:, 2] = command[:, 3] + 0.01
        qpos[:, 3], qpos[:, 5] = np.cos(tilt / 2), np.sin(tilt / 2)
        joints = np.concatenate([targets, self.commands.arms[worlds]], axis=1)
        qpos[:, 7:] = np.clip(joints + self.rng.normal(0, 0.03, joints.shape), self._lower, self._upper)
        self._targets[worlds] = np.clip(joints, self._lower, self._upper)
        self._delay[worlds] = self.rng.integers(0, self.config.largest_delay + 1, count)
        self.velocity[worlds], self.startled[worlds], self.carried[worlds] = 0.0, False, 0.0
        self._state[worlds] = 0
        self.qpos[worlds] = qpos
        self.qvel[worlds] = self.rng.normal(0, 0.1, (count, 6 + _JOINTS))
        self.action[worlds] = self.previous_action[worlds] = 0
        self.ticks[worlds] = 0
        qvel = self.qvel[worlds]
        self.history[worlds] = features.frame(qpos[:, 3:7], qvel[:, 3:6], qpos[:, 7:], qvel[:, 6:])[:, None]
        self.privileged[worlds] = 0
        self._mean_error[worlds] = 0
        self.privileged[worlds, 7] = qpos[:, 2]

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what the actor sees (with sensor noise) and what the critic sees, float32."""
        noisy = self.history + self.rng.uniform(-1, 1, self.history.shape) * _NOISE
        velocity = self.velocity + self.rng.normal(0, _ODOMETRY_NOISE, self.velocity.shape)
        seen = features.observation(
            noisy, self.action, self.commands.arms, self.commands.current, self.phase, self.standing, velocity
        )
        return seen.astype(np.float32), np.concatenate([seen, self.privileged], axis=1).astype(np.float32)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance all worlds by one control tick.

        Args:
            actions: (N, 15).

        Returns:
            Rewards (N,), fell (N,) bool, ended (N,) bool (fell or time is up). The caller resets ended worlds.
        """
        actions = np.clip(actions, -features.ACTION_LIMIT, features.ACTION_LIMIT)
        self.commands.advance(self.level, self.standing)
        self.phase, self.stopped, self.standing = reference.advance_clock(
            self.phase, self.stopped, self.standing, self.commands.current[:, :3], self.startled
        )
        targets = np.concatenate(
            [
                self.reference(
                    self.commands.current,
                    self.phase,
                    self.standing,
                    self.velocity,
                    self.commands.arms,
                    self.carried,
                )
                + actions * reference.action_scale(self.standing, self.commands.current[:, 3:]),
                self.commands.arms,
            ],
            axis=1,
        )
        targets = np.clip(targets, self._lower, self._upper)
        late = (np.arange(SUBSTEPS) < self._delay[:, None])[..., None]
        control = np.where(late, self._targets[:, None], targets[:, None])
        self._targets = targets
        self._state, sensors = self._physics.step(self._state, control)
        measured = rewards.measure(self.qpos, self.qvel, sensors, self._address)
        error = rewards.planar_error(measured, self.commands.current)
        self._mean_error += (error - self._mean_error) * (CONTROL_DT / _AVERAGED_S)
        reward, self.terms = rewards.total(
            measured,
            self.commands.current,
            self.phase,
            self.standing,
            actions,
            self.action,
            self.previous_action,
            self._mean_error,
        )
        fell = self._fell(measured) | ~np.isfinite(reward)
        self.commands.remember(np.nonzero(fell)[0])
        reward = np.where(fell, -1.0, np.nan_to_num(reward) * 0.2)
        self.previous_action, self.action = self.action, actions.copy()
        self._push()
        qpos, qvel = self.qpos, self.qvel
        frame = features.frame(qpos[:, 3:7], qvel[:, 3:6], qpos[:, 7:], qvel[:, 6:])
        legs, leg_rates = qpos[:, 7 : 7 + _LEGS], qvel[:, 6 : 6 + _LEGS]
        down = features.gravity(qpos[:, 3:7])
        velocity, sole_tilt, _ = odometry.estimate(down, qvel[:, 3:6], legs, leg_rates)
        self.carried = self.reference.arm_load.weigh(
            self.carried,
            self._targets[:, reference.NUM_LOWER :],
            qpos[:, 7 + reference.NUM_LOWER :],
            qvel[:, 6 + reference.NUM_LOWER :],
            attitude.in_torso(down, qpos[:, 7 + _LEGS : 7 + reference.NUM_LOWER]),
            CONTROL_DT,
        )
        self.velocity = odometry.smooth(self.velocity, velocity)
        self.startled = reference.startled(self.velocity, sole_tilt)
        self.history = np.concatenate([self.history[:, 1:], frame[:, None]], axis=1)
        self.privileged = np.concatenate(
            [
                measured.velocity,
                measured.vertical_velocity[:, None],
                measured.touch * 0.005,
                measured.sole_height * 5,
                measured.height[:, None],
                measured.torso_pitch[:, None],
                measured.torso_roll[:, None],
            ],
            axis=1,
        )
        self.ticks += 1
        self.tracking = rewards.tracking(measured, self.commands.current, self.standing)
        return reward, fell, fell | (self.ticks >= self.config.episode_ticks)

    def _fell(self, measured: rewards.Measured) -> np.ndarray:
        return (
            (measured.height < 0.28)
            | (np.abs(measured.torso_roll) > 0.9)
            | (measured.torso_pitch > 1.6)
            | (measured.torso_pitch < -0.8)
            | (np.abs(measured.height - self.commands.current[:, 3]) > 0.25)
        )

    def _push(self) -> None:
        struck = self.pushed & (self.rng.random(self.config.num_worlds) < self.config.push_probability)
        worlds = np.nonzero(struck)[0]
        speed = self.config.push_speed * self.push_level * self.rng.uniform(0.3, 1.0, len(worlds))
        angle = self.rng.uniform(-np.pi, np.pi, len(worlds))
        self.qvel[worlds, :2] += np.column_stack([speed * np.cos(angle), speed * np.sin(angle)])

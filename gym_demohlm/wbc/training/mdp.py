"""The Markov decision process of the whole-body controller: N training worlds on a CPU or a GPU, all else in NumPy.

Joint targets = reference(command, clock) + scale * action. Actions are 15 numbers at 50 Hz; arms follow random targets.
What the policy sees and what becomes of its actions is the tick that runs on the robot, ``control.tick``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from gym_demohlm.control import attitude, features, gait_clock, reference
from gym_demohlm.control.settings import UNTRIMMED, Gait, Settings
from gym_demohlm.control.tick import STATE_SIZE, Sensors, Situation, Tick
from gym_demohlm.robot.physics import PHYSICS, Physics
from gym_demohlm.timing import CONTROL_DT
from gym_demohlm.wbc.training import rewards
from gym_demohlm.wbc.training.commands import CommandSampler
from gym_demohlm.wbc.training.model import LARGEST_LOAD, SUBSTEPS, variants
from gym_demohlm.wbc.training.physics import STATE, make_physics
from gym_demohlm.wbc.training.quasi_static import tables

_JOINTS = len(features.OBSERVED_JOINTS)
_ARMS = len(features.OBSERVED_ARM_JOINTS)
_AVERAGED_S = 0.6  # s: time constant of the averaged velocity error, about a gait period
_RECENT = 100  # ticks after a push that count as pushed
# Of the actor's observation alone, uniform: gyro, gravity, joints, joint velocities of every frame; odometry, normal.
_FRAME_NOISE = np.concatenate([np.full(3, 0.05), np.full(3, 0.03), np.full(_JOINTS, 0.01), np.full(_JOINTS, 0.05)])
_NOISE = np.tile(_FRAME_NOISE, features.HISTORY)
_ODOMETRY_NOISE = 0.03  # m/s

# What the critic sees besides the actor's inputs: name -> its mirror, whose length is its size.
_PRIVILEGED: dict[str, features.Mirror] = {
    "base velocity": ([0, 1, 2], [1, -1, 1]),
    "foot contact": features.SIDES_MIRROR,
    "foot height": features.SIDES_MIRROR,
    "base height, torso pitch and roll": ([0, 1, 2], [1, 1, -1]),
    "hand loads": features.SIDES_MIRROR,
    "friction, torso mass, delay": ([0, 1, 2], [1, 1, 1]),
    "averaged error": ([0, 1, 2], [1, -1, -1]),
    "next command": features.COMMAND_MIRROR,
    "where the arms go": features.mirror_joints(features.OBSERVED_ARM_JOINTS),
}
_NUM_PRIVILEGED = sum(len(source) for source, _ in _PRIVILEGED.values())
CRITIC_SIZE = features.OBSERVATION_SIZE + _NUM_PRIVILEGED


def _critic_mirror() -> tuple[np.ndarray, np.ndarray]:
    source, sign = features.OBSERVATION_MIRROR
    return features.join([(source.tolist(), sign.tolist()), *_PRIVILEGED.values()])


CRITIC_MIRROR = _critic_mirror()


@dataclass(frozen=True, kw_only=True)
class MdpConfig:
    """Size and difficulty of the training worlds.

    Attributes:
        num_worlds: Worlds stepped together.
        num_variants: Randomised models shared among them; each episode has one of them.
        num_threads: Threads of mujoco.rollout.
        warp_device: Where mujoco_warp runs the physics (``cuda``, ``cpu``); with None it is mujoco.rollout.
        episode_ticks: Length of an episode [control ticks].
        push_speed: Largest sudden change of the base's horizontal velocity [m/s].
        push_turn: Largest sudden change of each component of its angular velocity [rad/s].
        push_every: Fewest and most ticks between two pushes of a world that is pushed.
        pushed_share: Share of the worlds that are pushed; the others learn to be accurate.
        largest_load: Largest mass in each hand [kg].
        critic_knows: Whether the critic sees what the actor does not, such as loads, friction and the next command.
        largest_delay: Substeps until new targets reach the motors, at most (of 5 ms; drawn for every episode).
        use_reference: Whether actions correct the reference pose; without it they correct the pose of rest.
        gait: Of the reference.
        physics: Of the robot.
        reward_table: Terms with their weights and scales.
        seed: Of everything random.
    """

    num_worlds: int = 256
    num_variants: int = 128
    num_threads: int = 1
    warp_device: str | None = None
    episode_ticks: int = 1000
    push_speed: float = 1.0
    push_turn: float = 0.5
    push_every: tuple[int, int] = (100, 250)
    pushed_share: float = 0.6
    largest_load: float = LARGEST_LOAD
    critic_knows: bool = True
    largest_delay: int = 4
    use_reference: bool = True
    gait: Gait = gait_clock.GAIT
    physics: Physics = PHYSICS
    reward_table: Mapping[str, rewards.RewardTerm] = field(default_factory=lambda: rewards.REWARDS)
    seed: int = 1

    @property
    def settings(self) -> Settings:
        """What a controller trained so needs at run time."""
        return Settings(gait=self.gait, physics=self.physics)


class WholeBodyMdp:
    """N robots learning to follow commands.

    Attributes:
        level: Curriculum in [0, 1]: widens the command ranges and the arms' motion.
        push_level: Curriculum in [0, 1]: strengthens the pushes.
        now: What the policy is to act on.
        memory: (N, STATE_SIZE) what the controllers remember of the tick before, as at run time.
        targets: (N, 23) of the servos in the tick before [rad].
    """

    def __init__(self, config: MdpConfig) -> None:
        self.config = config
        self.rng = np.random.default_rng(config.seed)
        n = config.num_worlds
        made = variants(config.num_variants, self.rng, config.physics, config.largest_load)
        self.model = made[0].model
        self._facts = np.stack([variant.facts for variant in made])
        self._variant = np.arange(n) % len(made)
        self._physics = make_physics(
            [variant.model for variant in made],
            n,
            SUBSTEPS,
            num_threads=config.num_threads,
            warp_device=config.warp_device,
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
        self.reference = (reference.Reference if config.use_reference else reference.Rest)(*tables(), config.gait)
        self._tick = Tick(self.reference, Settings(gait=config.gait, trim=UNTRIMMED))
        self.commands = CommandSampler(n, self.rng)
        self.level = self.push_level = 0.0
        self._is_pushed = np.arange(n) < round(config.pushed_share * n)
        self._until_push, self._since_push = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
        self.memory = np.zeros((n, STATE_SIZE))
        self.previous_action = np.zeros((n, features.ACTION_SIZE))
        self.privileged = np.zeros((n, 10))
        self._mean_error = np.zeros((n, 3))
        self._air = rewards.Air(lifted=np.zeros((n, 2), dtype=bool), speed=np.zeros((n, 2)))
        self._delay, self.targets = np.zeros(n, dtype=int), np.zeros((n, _JOINTS))
        self.ticks = np.zeros(n, dtype=int)
        self.tracking: dict[str, float] = {}
        self.terms: dict[str, float] = {}
        self.now: Situation
        self.reset(np.arange(n))

    @property
    def settings(self) -> Settings:
        """What the tick goes by: the trim is for robots that have learned."""
        return self._tick.settings

    @property
    def pushed(self) -> np.ndarray:
        """Who was pushed within the last two seconds, (N,) bool."""
        return self._since_push < _RECENT

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
        command, arms = self.commands.start(worlds), self.commands.arms[worlds]
        walk = (np.abs(self.commands.goal[worlds, :3]) > gait_clock.WALK_THRESHOLD).any(axis=1)
        phase = self.rng.choice(self.config.gait.rest_phases, count)
        clock = gait_clock.Clock(phase, np.where(walk, 0.0, 2.0), np.logical_not(walk), np.zeros(count))
        moment = self.reference.arms_moment(command, arms, np.zeros((count, 2)))
        targets = self.reference.pose(command, gait_clock.at_rest(count), np.zeros((count, 2)), moment)
        lean, _ = attitude.lean(command[:, 4], command[:, 5], command[:, 6])
        _, tilt, _ = self.reference.statics(command[:, 3], lean)
        qpos = np.zeros((count, 7 + _JOINTS))
        qpos[:, 2] = command[:, 3] + 0.01
        qpos[:, 3], qpos[:, 5] = np.cos(tilt / 2), np.sin(tilt / 2)
        joints = np.concatenate([targets, arms], axis=1)
        qpos[:, 7:] = np.clip(joints + self.rng.normal(0, 0.03, joints.shape), self._lower, self._upper)
        self.targets[worlds] = np.clip(joints, self._lower, self._upper)
        self._delay[worlds] = self.rng.integers(0, self.config.largest_delay + 1, count)
        chosen = self.rng.integers(len(self._facts), size=count)
        if self._physics.assign(worlds, chosen):
            self._variant[worlds] = chosen
        self._state[worlds] = 0
        self.qpos[worlds] = qpos
        self.qvel[worlds] = self.rng.normal(0, 0.1, (count, 6 + _JOINTS))
        self.previous_action[worlds] = 0
        self.ticks[worlds] = 0
        self._until_push[worlds] = self.rng.integers(0, self.config.push_every[1], count)
        self._since_push[worlds] = _RECENT
        self.privileged[worlds] = 0
        self.privileged[worlds, 7] = qpos[:, 2]
        self._mean_error[worlds] = 0
        self._air.lifted[worlds] = False
        self.memory[worlds] = self._tick.start(self.sensors(worlds), command, clock, arms)
        self._perceive(worlds)

    def sensors(self, worlds: np.ndarray | slice = slice(None)) -> Sensors:
        """Return what some robots measure."""
        qpos, qvel = self.qpos[worlds], self.qvel[worlds]
        return Sensors(quat_wxyz=qpos[:, 3:7], gyro=qvel[:, 3:6], q=qpos[:, 7:], dq=qvel[:, 6:])

    def _perceive(self, worlds: np.ndarray | slice) -> None:
        """Find out what the policy is to act on, in some worlds."""
        goal, arms = self.commands.goal[worlds], self.commands.arms[worlds]
        found = self._tick.perceive(self.memory[worlds], self.sensors(worlds), goal, arms)
        if isinstance(worlds, slice) or len(worlds) == self.config.num_worlds:
            self.now = found
        else:
            self.now.replace_rows(worlds, found)

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what the actor sees (with sensor noise) and what the critic sees, float32."""
        seen = self.now.observation()
        facts, arms = self._facts[self._variant], self.commands.arm_goal
        delay = self._delay[:, None] / SUBSTEPS
        known = [self.privileged, facts, delay, self._mean_error, self.commands.goal, arms]
        critic = np.concatenate([seen, *known], axis=1)
        if not self.config.critic_knows:
            critic[:, seen.shape[1] :] = 0.0
        actor = seen.copy()
        actor[:, : len(_NOISE)] += self.rng.uniform(-1, 1, (len(seen), len(_NOISE))) * _NOISE
        actor[:, features.ODOMETRY] += self.rng.normal(0, _ODOMETRY_NOISE, (len(seen), 2))
        return actor.astype(np.float32), critic.astype(np.float32)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance all worlds by one control tick.

        Args:
            actions: (N, 15).

        Returns:
            Rewards (N,), fell (N,) bool, ended (N,) bool (fell or time is up). The caller resets ended worlds.
        """
        now, actions = self.now, np.clip(actions, -features.ACTION_LIMIT, features.ACTION_LIMIT)
        arms = np.clip(now.arms, self._lower[-_ARMS:], self._upper[-_ARMS:])
        targets = np.concatenate([self._tick.targets(now, actions), arms], axis=1)
        late = (np.arange(SUBSTEPS) < self._delay[:, None])[..., None]
        control = np.where(late, self.targets[:, None], targets[:, None])
        self.targets = targets
        self._state, sensors = self._physics.step(self._state, control)
        measured = rewards.measure(self.qpos, self.qvel, sensors, self._address, targets, self._air)
        self._air = rewards.Air.read(sensors, self._address)
        error = rewards.planar_error(measured, now.slewed)
        self._mean_error += (error - self._mean_error) * (CONTROL_DT / _AVERAGED_S)
        outcome = rewards.Outcome(
            m=measured,
            command=now.slewed,
            clock=now.clock,
            gait=self.config.gait,
            action=actions,
            last_action=now.last_action,
            action_before=self.previous_action,
            mean_error=self._mean_error,
        )
        reward, self.terms = rewards.total(outcome, self.config.reward_table)
        fell = self._fell(measured) | ~np.isfinite(reward)
        self.commands.remember(np.nonzero(fell)[0])
        reward = np.where(fell, -1.0, np.nan_to_num(reward) * 0.2)
        self.previous_action = now.last_action.copy()
        self.memory = now.remember(actions)
        self._push()
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
        self.tracking = rewards.tracking(measured, now.slewed, now.clock.standing)
        self.commands.advance(self.level)
        self._perceive(slice(None))
        return reward, fell, fell | (self.ticks >= self.config.episode_ticks)

    def _fell(self, measured: rewards.Measured) -> np.ndarray:
        return (
            (measured.height < 0.28)
            | (np.abs(measured.torso_roll) > 0.9)
            | (measured.torso_pitch > 1.6)
            | (measured.torso_pitch < -0.8)
            | (np.abs(measured.height - self.now.slewed[:, 3]) > 0.25)
        )

    def _push(self) -> None:
        self._until_push -= 1
        self._since_push += 1
        worlds = np.nonzero(self._is_pushed & (self._until_push <= 0))[0]
        self._until_push[worlds] = self.rng.integers(*self.config.push_every, len(worlds))
        self._since_push[worlds] = 0
        speed = self.config.push_speed * self.push_level * self.rng.uniform(0.1, 1.0, len(worlds))
        angle = self.rng.uniform(-np.pi, np.pi, len(worlds))
        self.qvel[worlds, :2] += np.column_stack([speed * np.cos(angle), speed * np.sin(angle)])
        turn = self.config.push_turn * self.push_level
        self.qvel[worlds, 3:6] += self.rng.uniform(-turn, turn, (len(worlds), 3))

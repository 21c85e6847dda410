"""The G1 velocity policies of the PyPI package ``holosoma-inference`` -> worlds that our benchmark can measure.

``demohlm benchmark controller --peer holosoma`` runs them on the same model and under the same commands and pushes as
our controller. What differs, all of it in the peer's favour or of its own choosing:

- It is asked for velocities only. Commands of height, torso and arms are drawn all the same but never reach it, so the
  errors of height and torso are left out and "standing" means standing upright.
- It moves all 29 joints itself, waist and arms too: its arms stay near its default pose, where ours swing. With
  ``moving_arms`` they go where the commands send them, with the servo gains that ours have, so that they bear a load.
  The policy sees them in its default pose then: shown where they are, which it never saw in training, it falls at once.
- Joint stiffness and damping, default pose, action and observation scales, gait period and control rate are its own,
  read from the package. Armature, torque limits and frictionless joints are the same in its training as in our first
  physics; the second one has dry friction, which the peer was not trained with.
- Episodes start in its default pose, soles on the floor.
- With ``own_range`` velocities are drawn from the range it was trained for, stored with its weights.

It was trained with pushes of up to 1 m/s and up to 3 kg more at the base, but without loads in the hands. On the robot
model of its own training package it walks as fast as on ours: what it lacks in speed is its own.
"""

import importlib.util
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot import g1
from gym_demohlm.robot.physics import PHYSICS, Physics
from gym_demohlm.simulation import Simulation, StepResult
from gym_demohlm.task import InitialState
from gym_demohlm.timing import CONTROL_DT
from gym_demohlm.wbc.evaluation import benchmark as ours
from gym_demohlm.wbc.evaluation.trial import Disturbance, trial_task
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange

PEERS = {"holosoma": "fastsac_g1_29dof.onnx", "holosoma-ppo": "ppo_g1_29dof.onnx"}
"""Name -> file in the package; the first is the one that the package runs by default."""
NOT_COMMANDED = ("height_error", "torso_pitch_error", "torso_roll_error", "torso_yaw_error", "hand_error")
"""What a velocity policy is not asked for."""
_INSTALL = 'uv pip install "holosoma-inference>=0.1.3,<0.2" onnxruntime'  # parts are built: needs a C compiler
_LARGEST_ACTION = 100.0  # where the package clips
_ARMS = slice(g1.BODY_JOINTS.index(g1.ARM_JOINTS[0]), None)  # of the body joints
_STILL = 0.01  # m/s, rad/s: slower commands mean "stand"


@dataclass(frozen=True, kw_only=True)
class PeerPolicy:
    """One policy and what it expects of its robot.

    Attributes:
        network: Observation (1, size) float32 -> action (1, 29).
        terms: Name and scale of the observation's parts, in their order.
        default: (29,) default pose in the order of ``g1.BODY_JOINTS`` [rad].
        stiffness: (29,) [Nm/rad].
        damping: (29,) [Nms/rad].
        joint_index: (29,) where each joint of ``g1.BODY_JOINTS`` is among the policy's.
        action_scale: Joint targets = default + action_scale * action [rad].
        gait_period_s: Time of two steps [s].
        forward, sideways: Velocities trained for, (low, high) [m/s].
        yaw_rate: Trained for, (low, high) [rad/s].
    """

    network: Callable[[np.ndarray], np.ndarray]
    terms: tuple[tuple[str, float], ...]
    default: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    joint_index: np.ndarray
    action_scale: float
    gait_period_s: float
    forward: tuple[float, float]
    sideways: tuple[float, float]
    yaw_rate: tuple[float, float]


def load_policy(name: str) -> PeerPolicy:
    """Read a policy and its configuration out of the installed package.

    Raises:
        UnknownNameError: The package has no such policy.
        SceneError: Its package is not installed, or the policy is of another kind than this module knows.
    """
    if name not in PEERS:
        raise UnknownNameError("peer", name, PEERS)
    for module in ("holosoma_inference", "onnxruntime"):
        if importlib.util.find_spec(module) is None:
            raise SceneError(f"an installation without {module}", "the peer's package", _INSTALL)
    import holosoma_inference
    import onnxruntime
    from holosoma_inference.config.config_values import observation, robot, task

    path = Path(next(iter(holosoma_inference.__path__))) / "models" / "loco" / "g1_29dof" / PEERS[name]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    facts = {key: json.loads(text) for key, text in session.get_modelmeta().custom_metadata_map.items()}
    seen, walking = observation.loco_g1_29dof, task.locomotion
    if walking.rl_rate * CONTROL_DT != 1.0 or seen.history_length_dict["actor_obs"] != 1:
        raise SceneError(
            f"a peer at {walking.rl_rate} Hz with {seen.history_length_dict} frames",
            f"{1 / CONTROL_DT:.0f} Hz and one frame",
            "install holosoma-inference 0.1",
        )
    names = [joint.removesuffix("_joint") for joint in facts["dof_names"]]
    order = np.array([names.index(joint) for joint in g1.BODY_JOINTS])
    configured = [joint.removesuffix("_joint") for joint in robot.g1_29dof.dof_names]
    default = dict(zip(configured, robot.g1_29dof.default_dof_angles, strict=True))
    ranges = {key: (float(low), float(high)) for key, (low, high) in facts["command_ranges"].items()}
    feed = session.get_inputs()[0].name
    return PeerPolicy(
        network=lambda observed: np.asarray(session.run(None, {feed: observed})[0]),
        # The package joins the parts of an observation in alphabetical order.
        terms=tuple((term, float(seen.obs_scales[term])) for term in sorted(seen.obs_dict["actor_obs"])),
        default=np.array([default[joint] for joint in g1.BODY_JOINTS]),
        stiffness=np.array(facts["kp"])[order],
        damping=np.array(facts["kd"])[order],
        joint_index=order,
        action_scale=float(walking.policy_action_scale),
        gait_period_s=float(walking.gait_period),
        forward=ranges["lin_vel_x"],
        sideways=ranges["lin_vel_y"],
        yaw_rate=ranges["ang_vel_yaw"],
    )


class PeerController:
    """N copies of a peer's policy behind the interface of our controller.

    Args:
        num_worlds: N.
        policy: The policy.
        moving_arms: Whether arms follow the commands; the policy moves them otherwise.
        physics: Of its robots.

    Attributes:
        policy: The policy.
        moving_arms: Whether arms follow the commands.
        physics: Of its robots.
        state: (N, 32) last action of the 29 joints, phases of the left and right foot, and whether it stands.
        velocity: (N, 3) what to follow instead of the commands' velocities, which the simulation clips to our bounds.
    """

    def __init__(
        self, num_worlds: int, policy: PeerPolicy, moving_arms: bool = False, physics: Physics = PHYSICS
    ) -> None:
        self.policy, self.moving_arms, self.physics = policy, moving_arms, physics
        self.state = np.zeros((num_worlds, len(g1.BODY_JOINTS) + 3))
        self.velocity = np.zeros((num_worlds, 3))

    @property
    def cycle_s(self) -> float:
        """Period of its gait [s]."""
        return self.policy.gait_period_s

    @property
    def standing(self) -> np.ndarray:
        """Who does not step, (N,) bool."""
        return self.state[:, -1] > 0.5

    def reset(self, worlds: np.ndarray, sensed: Proprioception) -> None:
        """Start some worlds anew: no action yet, left foot at the start of its cycle, right foot half a cycle away."""
        self.state[worlds] = 0.0
        self.state[worlds, -2] = np.pi
        self.velocity[worlds] = 0.0

    def step(self, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Return joint targets (M, 29) [rad] for one tick; arguments as of ``WholeBodyController.step``."""
        policy = self.policy
        chosen = slice(None) if worlds is None else worlds
        state, velocity = self.state[chosen].copy(), self.velocity[chosen]
        joints = len(g1.BODY_JOINTS)
        phases = state[:, joints : joints + 2] = _advance(state[:, joints:], velocity, policy.gait_period_s)
        state[:, -1] = _stands(velocity)
        order = np.argsort(policy.joint_index)  # of the policy's joints among ours
        seen = self._seen(sensed)
        parts = {
            "actions": state[:, :joints],
            "base_ang_vel": sensed.gyro,
            "projected_gravity": _gravity(sensed.quat_wxyz),
            "command_lin_vel": velocity[:, :2],
            "command_ang_vel": velocity[:, 2:],
            "dof_pos": (seen.q - policy.default)[:, order],
            "dof_vel": seen.dq[:, order],
            "sin_phase": np.sin(phases),
            "cos_phase": np.cos(phases),
        }
        observed = np.concatenate([parts[name] * scale for name, scale in policy.terms], axis=1).astype(np.float32)
        actions = np.array([policy.network(row[None])[0] for row in observed]).reshape(-1, joints)
        state[:, :joints] = np.clip(actions, -_LARGEST_ACTION, _LARGEST_ACTION)
        self.state[chosen] = state
        targets = policy.default + policy.action_scale * state[:, policy.joint_index]
        if self.moving_arms:
            targets[:, _ARMS] = commands[:, command.ARMS]
        return targets

    def _seen(self, sensed: Proprioception) -> Proprioception:
        """Return what the policy is shown: arms that do not follow it rest in its default pose."""
        if not self.moving_arms:
            return sensed
        q, dq = sensed.q.copy(), sensed.dq.copy()
        q[:, _ARMS], dq[:, _ARMS] = self.policy.default[_ARMS], 0.0
        return replace(sensed, q=q, dq=dq)


class PeerSimulation(Simulation):
    """Worlds of a trial with a peer in them: its gains in the motors, its default pose at the start.

    Args:
        num_worlds: N.
        policy: The peer.
        disturbance: None by default.
        num_threads: Threads of the physics.
        moving_arms: Whether arms follow the commands, with the gains of ours.
        physics: Of the robots.
    """

    def __init__(
        self,
        num_worlds: int,
        policy: PeerPolicy,
        disturbance: Disturbance | None = None,
        num_threads: int = 1,
        *,
        moving_arms: bool = False,
        physics: Physics = PHYSICS,
    ) -> None:
        self.peer = PeerController(num_worlds, policy, moving_arms, physics)
        task = trial_task(disturbance)

        def build(spec: mujoco.MjSpec) -> None:
            task.build(spec)
            for joint, stiffness, damping in zip(g1.BODY_JOINTS, policy.stiffness, policy.damping, strict=True):
                if moving_arms and joint in g1.ARM_JOINTS:
                    continue
                actuator = spec.actuator(joint)
                actuator.gainprm[0] = stiffness
                actuator.biasprm[1], actuator.biasprm[2] = -stiffness, -damping

        super().__init__(replace(task, name="PeerTrial", build=build), num_worlds, num_threads, self.peer)

    def reset(self, initial_states: Sequence[InitialState], worlds: np.ndarray | None = None) -> None:
        """Start episodes in the peer's default pose, soles on the floor; arguments as of ``Simulation.reset``."""
        super().reset(initial_states, worlds)
        rows = np.arange(self.num_worlds) if worlds is None else worlds
        for joint, angle in zip(g1.BODY_JOINTS, self.peer.policy.default, strict=True):
            self.set_joint(f"{joint}_joint", angle, worlds=rows)
        T_world_pelvis = self.pose("pelvis")[rows]
        T_world_pelvis[:, 2, 3] -= np.minimum(*(self.pose(f"{side}_sole")[rows, 2, 3] for side in g1.SIDES))
        self.set_pose("pelvis", T_world_pelvis, rows)
        self.peer.reset(rows, self.proprioception(rows))

    def step(self, commands: np.ndarray, active: np.ndarray | None = None) -> StepResult:
        """Hand the peer its velocities unclipped, and step; arguments as of ``Simulation.step``."""
        self.peer.velocity = np.array(commands[:, command.VELOCITY], dtype=np.float64)
        return super().step(commands, active)


def benchmark(
    name: str,
    num_worlds: int,
    seconds: float,
    seed: int,
    num_threads: int = 2,
    ranges: CommandRange | None = None,
    *,
    largest_hand_load: float = ours.LARGEST_HAND_LOAD,
    own_range: bool = False,
) -> dict[str, Any]:
    """Return what ``ours.benchmark`` returns, measured on a peer, with null for what it is not asked for.

    Args:
        name: One of ``PEERS``.
        num_worlds: Robots in all, each one episode.
        seconds: Length of an episode.
        seed: Of loads, commands and pushes: the same commands as for our controller.
        num_threads: Threads of the physics.
        ranges: What to draw commands from.
        largest_hand_load: [kg].
        own_range: Draw velocities from the range that the peer was trained for.
    """
    policy = load_policy(name)
    ranges = ranges or CommandRange()
    trained = {"forward": policy.forward, "sideways": policy.sideways, "yaw_rate": policy.yaw_rate}
    if own_range:
        ranges = replace(ranges, **trained)

    def make(worlds: int, disturbance: Disturbance, threads: int) -> Simulation:
        return PeerSimulation(worlds, policy, disturbance, threads)

    found = ours.benchmark(
        num_worlds, seconds, seed, num_threads, ranges, largest_hand_load=largest_hand_load, make=make
    )
    found |= dict.fromkeys((*NOT_COMMANDED, "largest_roll", "largest_yaw"))
    return {
        **found,
        "peer": f"{name}, in its own range" if own_range else name,
        "peer_file": PEERS[name],
        "commanded": {axis: getattr(ranges, axis) for axis in trained},
        "trained_for": trained,
    }


def _advance(clock: np.ndarray, velocity: np.ndarray, period_s: float) -> np.ndarray:
    """Return the next phases of the feet (N, 2) in [-pi, pi).

    Args:
        clock: (N, 3) phases, and whether the robot stood.
        velocity: (N, 3) commanded.
        period_s: Of the gait.
    """
    phases = np.fmod(clock[:, :2] + 2 * np.pi * CONTROL_DT / period_s + np.pi, 2 * np.pi) - np.pi
    first = np.where(clock[:, 2:] > 0.5, np.array([0.0, np.pi]), phases)  # a robot that stood starts with its left foot
    return np.where(_stands(velocity)[:, None], np.pi, first)


def _stands(velocity: np.ndarray) -> np.ndarray:
    return (np.hypot(velocity[:, 0], velocity[:, 1]) < _STILL) & (np.abs(velocity[:, 2]) < _STILL)


def _gravity(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the direction of gravity in the pelvis frame, (N, 4) -> (N, 3)."""
    w, x, y, z = quat_wxyz.T
    return np.stack([2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1], axis=1)

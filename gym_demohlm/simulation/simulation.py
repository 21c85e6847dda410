"""Commands at 10 Hz -> N worlds of one task stepped together: whole-body controller at 50 Hz, physics at 500 Hz.

What makes a world is its physics state, the controller's state, the last command and the neck's target; nothing hidden
is carried over (the constraint solver starts cold at every controller tick). So a world gives the same bits alone or in
any batch, on any number of threads, and from a restored snapshot.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco import rollout

from gym_demohlm import poses
from gym_demohlm.control import command, controllers
from gym_demohlm.control.gaze import GazeController
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot import g1
from gym_demohlm.simulation.disturbances import Disturbances
from gym_demohlm.simulation.posture import ARMS, start_posture, towards_rest
from gym_demohlm.simulation.worlds import Worlds
from gym_demohlm.task import InitialState, Task
from gym_demohlm.timing import CONTROL_DT, STEP_DT, TICKS
from gym_demohlm.variation import NONE, Conditions, Variation

MAX_ARM_SPEED = 5.0  # rad/s of the arms' targets: above what inverse kinematics asks for, below what motors can do
GAZE_STEPS = 25  # after which the neck has turned from straight ahead to anywhere
MAX_SPEED = 500.0  # largest |qvel| [m/s, rad/s] of a simulation that still means something

_CONTROL_SPEC = (
    mujoco.mjtState.mjSTATE_CTRL.value
    | mujoco.mjtState.mjSTATE_MOCAP_POS.value
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
)
_BOUNDS = command.LOWER, command.UPPER
OnTick = Callable[[np.ndarray, np.ndarray], None]
"""Called after a controller tick with the worlds (n,) that took part and are sound, and the commands (N, 23)."""


class Pool(Protocol):
    """What steps the physics: ``mujoco.rollout.Rollout``, or a stand-in that looks on."""

    def rollout(self, *arguments: Any, **options: Any) -> Any:  # noqa: ANN401
        """Step worlds; see ``mujoco.rollout.Rollout.rollout``."""
        ...

    def close(self) -> None:
        """Stop the threads."""
        ...


def make_pool(num_threads: int) -> Pool:
    """Return what steps the physics on some threads; with one, in the thread that asks."""
    return rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)


class Controller(Protocol):
    """What the simulation needs of a whole-body controller; each row must have the same bits alone and in a batch."""

    state: np.ndarray
    """(num_worlds, state_size), everything it remembers."""

    def reset(self, worlds: np.ndarray, sensed: Proprioception) -> None:
        """Forget the past of some worlds.

        Args:
            worlds: (M,) indices.
            sensed: What their robots sense, M rows.
        """
        ...

    def step(self, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Return the targets (M, 29) [rad] of the body joints for one tick.

        Args:
            sensed: What the robots sense, M rows.
            commands: (M, 23), see command.NAMES.
            worlds: (M,) which worlds these rows belong to; all by default.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class StepResult:
    """What happened during one step of 0.1 s; rows of worlds that were left out are zero.

    Attributes:
        commands: (N, 23) as applied, inside the bounds.
        num_clipped: (N,) how many numbers of each command were out of bounds.
        contact_forces: (N, 5, pairs) normal force of each of task.contact_pairs, mean of each tick [N].
        collision_forces: (N, 5) largest normal force between robot and obstacles in each tick [N].
        unstable: (N,) whether the physics broke down, in this step or before.
    """

    commands: np.ndarray
    num_clipped: np.ndarray
    contact_forces: np.ndarray
    collision_forces: np.ndarray
    unstable: np.ndarray


class Simulation(Worlds):
    """N worlds of one task that can be reset, stepped, kept and restored; see ``Worlds`` for what can be asked.

    Args:
        task: The task.
        num_worlds: N.
        num_threads: Threads that step the physics; one does without a pool.
        controller: Of the robots: for N worlds, or the name, path or hash of one (``control.controllers``). A
            controller with a ``physics``, as ours have, brings it.
        pool: What steps the physics, for as many threads; ``make_pool(num_threads)`` by default.
        variation: What may differ from world to world; a world's conditions are in its initial state.

    Attributes:
        on_tick: Called after each controller tick, see ``OnTick``; None by default.
        p_camera_gaze: (N, 3) where the gaze target seems to be in the frame ``head_camera`` [m], for the neck; None,
            the default, for where it is. A reset turns the neck to where it is.

    Raises:
        SceneError: ``num_worlds`` or ``num_threads`` is less than 1, the controller is for another number of worlds, or
            its file is damaged.
        UnknownNameError: No controller is called so.
    """

    def __init__(
        self,
        task: Task,
        num_worlds: int = 1,
        num_threads: int = 1,
        controller: Controller | str | None = None,
        pool: Pool | None = None,
        variation: Variation = NONE,
    ) -> None:
        if num_worlds < 1 or num_threads < 1:
            raise SceneError(f"num_worlds={num_worlds}, num_threads={num_threads}", "at least 1 each", "raise them")
        if controller is None or isinstance(controller, str):
            controller = WholeBodyController(num_worlds, controllers.find(controller or controllers.DEFAULT))
        if len(controller.state) != num_worlds:
            got = f"a controller for {len(controller.state)} worlds"
            raise SceneError(got, f"one for {num_worlds}", "make it for as many, or name it")
        ours = controller.settings if isinstance(controller, WholeBodyController) else None
        super().__init__(task, num_worlds, getattr(controller, "physics", None), variation)
        model = self.model
        self._controller: Controller = controller
        if ours:
            self.scene.set_gains(ours.stiffness, ours.damping)
        self._gaze = GazeController()
        threads = min(num_threads, num_worlds)
        self._pool = make_pool(threads) if pool is None else pool
        self.on_tick: OnTick | None = None
        self.p_camera_gaze: np.ndarray | None = None
        self._data = [mujoco.MjData(self.scene.physics) for _ in range(threads)]
        # Inputs and outputs of the rollouts, made once; the first rows are used where fewer worlds take part.
        substeps = round(CONTROL_DT / model.opt.timestep)  # physics steps a tick
        self._control = np.zeros((num_worlds, substeps, model.nu + 7 * model.nmocap))
        self._states = np.zeros((num_worlds, substeps, self._physics.shape[1]))
        self._sensors = np.zeros((TICKS, num_worlds, substeps, model.nsensordata))
        self._stepped = np.arange(num_worlds)
        self._models = [(self.scene.physics, self.scene.untouched)] * num_worlds
        self._disturbances = Disturbances(num_worlds) if variation else None
        self._targets = np.zeros((num_worlds, len(g1.BODY_JOINTS)))  # rad, of the tick before, for servos that are late
        self.reset([task.default_state()] * num_worlds)

    @property
    def variation(self) -> Variation:
        """What may differ from world to world."""
        return self.scene.variation

    def vary(self, state: InitialState) -> InitialState:
        """Return an initial state with the conditions of its episode, which are a function of task and start.

        A start that has conditions already keeps them, and under the variation ``none`` it stays as it is.
        """
        if not self.variation or Conditions.read(state):
            return state
        text = json.dumps([self.task.name, state], sort_keys=True)
        entropy = int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "little")
        return {**state, **self.variation.draw(entropy, self.scene.loose).write()}

    def reset(self, initial_states: Sequence[InitialState], worlds: np.ndarray | None = None) -> None:
        """Put worlds at the start of an episode: robot at rest, objects and supports where the states say.

        Conditions in the states become those of the worlds; none are drawn here, see ``vary``.

        Args:
            initial_states: One a world.
            worlds: Which worlds; all of them by default.

        Raises:
            SceneError: A state that is not two times three finite numbers, one with conditions of a group that does not
                vary here, or not one a world.
        """
        rows = self._rows(worlds)
        if len(initial_states) != len(rows):
            raise SceneError(f"{len(initial_states)} initial states", f"{len(rows)}, one a world", "give one each")
        conditions = [Conditions.read(state) for state in initial_states]
        models = [self.scene.world_models(found) for found in conditions]
        placed = [self.scene.place(state) for state in initial_states]  # all of them before the first change
        for row, (qpos, mocap_pos, mocap_quat) in zip(rows, placed, strict=True):
            self._physics[row] = 0.0
            self._qpos[row] = qpos
            self._mocap[row] = np.concatenate([mocap_pos.ravel(), mocap_quat.ravel()])
        self._command[rows] = command.rest()
        for row, found, model in zip(rows, conditions, models, strict=True):
            self._set_conditions(row, found, model)
        for array in (self._neck, self._forces, self._collisions, self._unstable, self._memory):
            array[rows] = 0
        for _ in range(GAZE_STEPS):  # it looks where it should from the first image on
            self._stale[rows] = True
            self._neck[rows] = self._next_neck(None)[rows]
            self._qpos[rows[:, None], self.scene.neck_qpos] = self._neck[rows]
        self._stale[rows] = True
        self._start_poses[rows] = np.stack([self.pose(entry.name)[rows] for entry in self.task.objects], axis=1)
        self._targets[rows] = self._qpos[rows[:, None], self.scene.body_qpos]
        self._controller.reset(rows, self._sense(rows))

    def _set_conditions(self, row: int, conditions: Conditions, models: tuple[mujoco.MjModel, mujoco.MjModel]) -> None:
        """Give a world that has just been placed its models, its disturbances and the posture of its robot."""
        self._conditions[row], self._models[row] = conditions, models
        if self._disturbances is None:
            return
        self._disturbances.reset(row, conditions)
        limits = self.model.jnt_range[[self.model.joint(f"{joint}_joint").id for joint in g1.BODY_JOINTS]]
        posture = self._put_clear(row, start_posture(conditions, limits))
        self._command[row, command.ARMS] = np.clip(
            self._command[row, command.ARMS] + (posture - g1.HOME)[ARMS], *(b[command.ARMS] for b in _BOUNDS)
        )

    def _put_clear(self, row: int, posture: np.ndarray) -> np.ndarray:
        """Give a world's robot a posture (29,) [rad], nearer to rest where it would be in its own way; return it."""
        for drawn in towards_rest(posture):
            self._qpos[row, self.scene.body_qpos] = drawn
            if not self.scene.robot_physics.self_collision or self._is_clear(row):
                return drawn
        return drawn

    def _is_clear(self, row: int) -> bool:
        """Return whether no part of a world's robot is inside another one."""
        self._load(row)
        mujoco.mj_fwdPosition(self.model, self._scratch)  # with the plain world's shapes: the robot has no others
        contacts, root = self._scratch.contact, self.model.body_rootid[self.model.body("pelvis").id]
        robot = self.model.body_rootid[self.model.geom_bodyid[contacts.geom]] == root
        return not (robot.all(axis=1) & (contacts.dist < 0.0)).any()

    def step(self, commands: np.ndarray, active: np.ndarray | None = None) -> StepResult:
        """Apply one command a world for 0.1 s.

        Velocities and torso are held; arm targets go linearly from the last command's to this one's, as far as
        ``MAX_ARM_SPEED`` takes them: a policy, or chance, cannot make the hands strike. A world whose
        physics breaks down keeps its last good state, is reported, and stays out until its next reset.

        Args:
            commands: (N, 23), see command.NAMES.
            active: (N,) which worlds to step, all by default; the others stay bit for bit as they are.

        Raises:
            CommandError: A shape that is not (N, 23), or numbers that are not finite in an active row.
        """
        num_worlds = self.num_worlds
        stepped = ~self._unstable if active is None else np.asarray(active, dtype=bool) & ~self._unstable
        if np.shape(commands) == (num_worlds, command.SIZE):
            commands = np.where(stepped[:, None], commands, self._command)
        valid, num_clipped = command.clip(command.validate(commands, num_worlds))
        num_clipped = np.where(stepped, num_clipped, 0)
        way, before = MAX_ARM_SPEED * STEP_DT, self._command[:, command.ARMS]
        valid[:, command.ARMS] = np.clip(valid[:, command.ARMS], before - way, before + way)
        forces = np.zeros((num_worlds, TICKS, self._forces.shape[1]))
        collisions = np.zeros((num_worlds, TICKS))
        rows = np.flatnonzero(stepped)
        previous_neck, next_neck = self._neck.copy(), self._next_neck(self.p_camera_gaze)
        previous_arms, next_arms = self._command[:, command.ARMS].copy(), valid[:, command.ARMS]
        now, touching = valid.copy(), self._touching(np.arange(num_worlds))
        models = [models[0 if touches else 1] for models, touches in zip(self._models, touching, strict=True)]
        for tick in range(TICKS):
            share = (tick + 1) / TICKS
            now[:, command.ARMS] = (1.0 - share) * previous_arms + share * next_arms
            self._neck[stepped] = ((1.0 - share) * previous_neck + share * next_neck)[stepped]
            rows = self._tick(tick, rows, now, models)
            if self.on_tick is not None:
                self.on_tick(rows, now)
        forces[rows], collisions[rows] = self._measure(rows)
        self._stepped = rows
        self._forces[rows], self._collisions[rows] = forces[rows, -1], collisions[rows, -1]
        self._command[stepped] = valid[stepped]
        self._stale[stepped] = True
        if self.task.memory is not None:
            self._memory[stepped] = self.task.memory.update(self, self._memory.copy())[stepped]
        return StepResult(
            commands=np.where(stepped[:, None], valid, 0.0),
            num_clipped=num_clipped,
            contact_forces=forces[..., : len(self.task.contact_pairs)],
            collision_forces=collisions,
            unstable=self._unstable.copy(),
        )

    @property
    def controller(self) -> Controller:
        """The whole-body controller of these worlds."""
        return self._controller

    @property
    def last_control(self) -> np.ndarray:
        """What the physics of the last tick was given, (n, motors, then mocap positions and quaternions)."""
        return self._control[: len(self._stepped), -1].copy()

    def readings(self, sensor: str) -> tuple[np.ndarray, np.ndarray]:
        """Return what a sensor read in every physics step of the last step of 0.1 s.

        Args:
            sensor: Its name in the model.

        Returns:
            The worlds that took part (n,), and their readings (n, physics steps, dim).

        Raises:
            UnknownNameError: The model has no such sensor.
        """
        model = self.model
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, sensor)
        if index < 0:
            raise UnknownNameError("sensor", sensor, [model.sensor(i).name for i in range(model.nsensor)])
        first, size = int(model.sensor_adr[index]), int(model.sensor_dim[index])
        values = self._sensors[:, : len(self._stepped), :, first : first + size]
        return self._stepped.copy(), np.concatenate(list(values), axis=1)

    def snapshot(self, worlds: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the whole state of worlds (all by default) as arrays with one row each, by the names of ``_state``."""
        rows = self._rows(worlds)
        return {name: values[rows].copy() for name, values in self._state().items()}

    def restore(self, snapshot: dict[str, np.ndarray], worlds: np.ndarray | None = None) -> None:
        """Bring worlds (all by default) back to a snapshot, bit for bit.

        Raises:
            SceneError: The snapshot is of another task, controller or number of worlds.
        """
        rows, state = self._rows(worlds), self._state()
        for name, values in state.items():
            expected = (len(rows), *values.shape[1:])
            got = snapshot[name].shape if name in snapshot else None
            if got != expected:
                raise SceneError(f"a snapshot with {name} of shape {got}", f"{expected}", "take it from such worlds")
        for name, values in state.items():
            values[rows] = snapshot[name]
        self._stale[rows] = True

    def _state(self) -> dict[str, np.ndarray]:
        """Return every array that makes a world, by its name in snapshots and in demonstrations on disk.

        A task that remembers nothing has no "memory", and a simulation without variation no "targets". Conditions are
        not in it: a snapshot is of a world under the conditions that it had.
        """
        state = {
            "physics": self._physics,
            "mocap": self._mocap,
            "controller": self._controller.state,
            "command": self._command,
            "neck": self._neck,
            "forces": self._forces,
            "collisions": self._collisions,
            "unstable": self._unstable,
            "start_poses": self._start_poses,
        }
        if self._disturbances is not None:
            state["targets"] = self._targets
        return state if self.task.memory is None else state | {"memory": self._memory}

    def set_pose(self, name: str, T_world_body: np.ndarray, worlds: np.ndarray | None = None) -> None:
        """Put a body somewhere else; its velocity and all other bodies stay as they are.

        Args:
            name: A body with a free joint, such as "pelvis" or an object, or a mocap body, such as a support.
            T_world_body: (4, 4), or (n, 4, 4), one for each of the worlds.
            worlds: (n,) which worlds; all by default.

        Raises:
            UnknownNameError: The model has no such frame.
            SceneError: The body can be moved in neither way.
        """
        rows, model = self._rows(worlds), self.model
        numbers = np.concatenate(poses.split(np.asarray(T_world_body, dtype=np.float64)), axis=-1)  # (7,) or (n, 7)
        kind, index = self.scene.frame(name)
        mocap = int(model.body_mocapid[index]) if kind == "body" else -1
        if mocap < 0:
            first, _ = self._free_addresses(name)
            self._qpos[rows, first : first + 7] = numbers
        else:
            quats = 3 * model.nmocap  # where they begin
            self._mocap[rows, 3 * mocap : 3 * mocap + 3] = numbers[..., :3]
            self._mocap[rows, quats + 4 * mocap : quats + 4 * mocap + 4] = numbers[..., 3:]
        self._stale[rows] = True

    def set_velocity(self, name: str, velocity: np.ndarray, worlds: np.ndarray | None = None) -> None:
        """Give a body with a free joint another velocity.

        Args:
            name: Of the body, such as "pelvis" or an object.
            velocity: (6,), or (n, 6), one for each of the worlds: linear in the world [m/s], then angular in the
                body's own frame [rad/s].
            worlds: (n,) which worlds; all by default.

        Raises:
            UnknownNameError: The model has no such frame.
            SceneError: The body has no free joint.
        """
        _, first = self._free_addresses(name)
        self._qvel[self._rows(worlds), first : first + 6] = velocity

    def set_joint(
        self,
        name: str,
        position: np.ndarray | float | None = None,
        velocity: np.ndarray | float | None = None,
        worlds: np.ndarray | None = None,
    ) -> None:
        """Bring a hinge or slide joint to another position, another velocity, or both.

        Args:
            name: Of the joint in the model, such as "left_knee_joint".
            position: One number or (n,) [rad or m]; None leaves it.
            velocity: One number or (n,) [rad/s or m/s]; None leaves it.
            worlds: (n,) which worlds; all by default.

        Raises:
            UnknownNameError: The model has no such joint.
        """
        rows, (qpos, qvel) = self._rows(worlds), self._joint_addresses(name)
        if position is not None:
            self._qpos[rows, qpos] = position
            self._stale[rows] = True
        if velocity is not None:
            self._qvel[rows, qvel] = velocity

    def close(self) -> None:
        """Stop the threads."""
        self._pool.close()

    def _tick(self, tick: int, rows: np.ndarray, commands: np.ndarray, models: Sequence[mujoco.MjModel]) -> np.ndarray:
        """Run one controller tick of some worlds; returns those of them whose physics is sound.

        Args:
            tick: Which of the step's ticks, where to keep the sensors.
            rows: (n,) the worlds.
            commands: (N, 23), a row for every world.
            models: N, what each world is stepped with.
        """
        count = len(rows)
        if count == 0:
            return rows
        everywhere = count == self.num_worlds
        chosen = slice(None) if everywhere else rows
        if self._disturbances is not None:
            push = self._disturbances.push(rows, self._ticks(rows))
            self._qvel[rows[:, None], self.scene.base_qvel + np.arange(2)] += push
        command_rows, before = commands[chosen], self._physics[chosen]
        worlds = None if everywhere else rows
        targets = self._controller.step(self._sense(rows if self._disturbances else chosen), command_rows, worlds)
        grippers = command_rows[:, command.GRIPPERS][:, : self.scene.num_grippers]
        control = self._control[:count]
        control[:] = np.concatenate([targets, self._neck[chosen], grippers, self._mocap[chosen]], axis=1)[:, None]
        if self._disturbances is not None:
            for index, steps in enumerate(self._disturbances.delay_steps[rows]):
                control[index, :steps, : targets.shape[1]] = self._targets[rows[index]]
            self._targets[rows] = targets
        states = self._states[:count]
        self._pool.rollout(
            [models[row] for row in rows],
            self._data,
            before,
            control,
            control_spec=_CONTROL_SPEC,
            skip_checks=True,
            nstep=control.shape[1],
            state=states,
            sensordata=self._sensors[tick, :count],
        )
        after = states[:, -1]
        # A MuJoCo warning ends a rollout early: time stands still or starts again. NaN fails the comparison of speeds.
        on_time = np.abs(after[:, 0] - before[:, 0] - CONTROL_DT) < 0.5 * self.model.opt.timestep
        sound = on_time & (np.abs(after[:, self._velocities]).max(axis=1) < MAX_SPEED)
        if sound.all():
            self._physics[chosen] = after
            return rows
        self._unstable[rows[~sound]] = True
        self._physics[rows[sound]] = after[sound]
        self._sensors[: tick + 1, : np.count_nonzero(sound)] = self._sensors[: tick + 1, :count][:, sound]
        return rows[sound]

    def sensed_joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [rad] and velocities [rad/s] of the body joints as the encoders read them, (N, 29) each."""
        if self._disturbances is None:
            return super().sensed_joints()
        sensed = self._sense(np.arange(self.num_worlds))
        return sensed.q, sensed.dq

    def _sense(self, worlds: np.ndarray | slice) -> Proprioception:
        """Return what robots sense of themselves now, with the noise that their worlds have."""
        sensed = self.proprioception(worlds)
        if self._disturbances is None or isinstance(worlds, slice):
            return sensed
        return self._disturbances.sense(sensed, worlds, self._ticks(worlds))

    def _ticks(self, rows: np.ndarray) -> np.ndarray:
        """Return how many controller ticks some worlds have made since their resets, (n,)."""
        return np.rint(self._physics[rows, 0] / CONTROL_DT).astype(np.int64)

    def _touching(self, rows: np.ndarray) -> np.ndarray:
        """Return whether a hand touched one of its objects at the end of the last step, for each of some worlds."""
        return np.any(self._forces[rows, : len(self.task.contact_pairs)] > 0.0, axis=1)

    def _measure(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the forces of measured pairs (n, 5, pairs) and collision forces (n, 5) of the step's sensors [N]."""
        sensors = self._sensors[:, : len(rows)]
        contacts = sensors[..., self.scene.contact_address].sum(axis=-1).mean(axis=2)
        collisions = sensors[..., self.scene.collision_address].sum(axis=-1).max(axis=(2, 3), initial=0.0)
        return contacts.swapaxes(0, 1), collisions.T

    def _next_neck(self, p_camera_target: np.ndarray | None) -> np.ndarray:
        """Return the neck's targets (N, 2) [rad] at the end of this step, turned towards the gaze target.

        Args:
            p_camera_target: (N, 3) where it seems to be [m]; where it is, by default.
        """
        if p_camera_target is None:
            camera = self.pose("head_camera")
            offset = self.pose(self.task.gaze_target)[:, :3, 3] - camera[:, :3, 3]
            p_camera_target = (camera[:, :3, :3] * offset[:, :, None]).sum(axis=1)
        # Columns in one piece, whatever N: NumPy may compute an arctangent by another routine where they are not.
        return self._gaze.step(self._neck, np.asfortranarray(p_camera_target), STEP_DT)

    def _rows(self, worlds: np.ndarray | None) -> np.ndarray:
        return np.arange(self.num_worlds) if worlds is None else np.atleast_1d(np.asarray(worlds, dtype=np.int64))

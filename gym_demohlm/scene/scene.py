"""Task and robot -> one compiled MuJoCo model, with the addresses of its joints, objects and sensors found by name."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot import g1, neck
from gym_demohlm.robot.physics import PHYSICS, Physics
from gym_demohlm.robot.robot import GRIPPER_JOINTS, actuator_names
from gym_demohlm.scene.building import CONTACT_SLOTS, collision_name, contact_name, scene_spec
from gym_demohlm.scene.shapes import Shapes
from gym_demohlm.task import InitialState, ObjectSpec, Task
from gym_demohlm.variation import NONE, Conditions, Variation
from gym_demohlm.variation.bodies import lowest_point, vary
from gym_demohlm.variation.factors import LIMBS
from gym_demohlm.variation.surroundings import place_clutter, resize_clutter, table_top

FRAME_ALIASES = {"torso": "torso_link"}
"""Short names of frames -> names in the MJCF. Every name of a body or site is a frame name too."""

_SHAPES_KEPT = 256  # worlds whose shapes are remembered


@dataclass(frozen=True)
class _Placement:
    """How an object's pose is set: at the qpos address of its free joint, or as a mocap body."""

    spec: ObjectSpec
    qpos_address: int | None
    mocap_index: int | None


@dataclass(frozen=True, kw_only=True)
class _Offsets:
    """How far objects are from their default poses.

    Attributes:
        x, y, z: Of all placed objects together [m].
        yaw: Of each placed object about itself [rad].
        own: By object, x and y [m] and yaw [rad] beside these.
    """

    x: float
    y: float
    z: float
    yaw: float
    own: dict[str, tuple[float, ...]]


class Scene:
    """One task's compiled model with its addresses. Only gains, what a `Memory` draws and `dress` change in it.

    Args:
        task: The task.
        physics: Of the robot; ``gym_demohlm.robot.physics.PHYSICS`` by default.
        variation: What may differ from world to world.

    Attributes:
        task: The task.
        variation: What may differ from world to world.
        robot_physics: Of the robot.
        model: The compiled model: robot, floor, light, camera, the task's bodies, contact sensors.
        physics: The model without visual geoms, for stepping. It gives the same bits in less time: MuJoCo clears a byte
            for each node of every mesh's bounding volumes at each step, and the robot's meshes have 800 000.
        untouched: ``physics`` without the no-slip pass, for worlds in which no hand touches an object.
        base_qpos: Address of the pelvis pose in qpos (7 numbers: position, quaternion wxyz).
        base_qvel: Address of the pelvis velocity in qvel (6 numbers: linear in the world, angular in the pelvis frame).
        body_qpos, body_qvel: (29,) addresses of the body joints in g1.BODY_JOINTS order.
        neck_qpos, neck_qvel: (2,) addresses of the neck joints, yaw and pitch.
        jaw_qpos, jaw_qvel: (2,) addresses of the left and right gripper jaw; empty with rubber hands.
        num_grippers: Number of gripper controls; they come after the controls of body and neck.
        contact_address: (pairs, slots) sensor addresses of the normal forces of task.contact_pairs, then force_pairs.
        collision_address: (obstacles, slots) sensor addresses of the normal forces of the robot on task.obstacles.
        loose: Names of the tracked objects that have a free joint.
    """

    def __init__(self, task: Task, physics: Physics | None = None, variation: Variation = NONE) -> None:
        self.task, self.variation, self.robot_physics = task, variation, physics or PHYSICS
        spec = scene_spec(task, self.robot_physics, variation)
        bare = spec.copy()
        bare.compiler.discardvisual = True
        try:
            self.model, self.physics = spec.compile(), bare.compile()
        except ValueError as error:
            raise SceneError(
                f"a scene of {task.name} that does not compile ({error})", "a valid MjSpec", "mend its build function"
            ) from error
        self.untouched = _without_noslip(self.physics)
        self._specs = (spec, bare) if variation else None
        self._plain_shapes = Shapes.of(self.model)
        self._known_shapes: dict[tuple[tuple[str, tuple[float, ...]], ...], Shapes] = {}
        self._gains: tuple[Sequence[float], Sequence[float]] | None = None
        model = self.model
        base = model.joint("floating_base_joint")
        self.base_qpos, self.base_qvel = int(base.qposadr[0]), int(base.dofadr[0])
        self.body_qpos, self.body_qvel = self._joints([f"{joint}_joint" for joint in g1.BODY_JOINTS])
        self.neck_qpos, self.neck_qvel = self._joints([f"{joint}_joint" for joint in neck.NECK_JOINTS])
        jaws = GRIPPER_JOINTS if task.hands == "gripper" else ()
        self.jaw_qpos, self.jaw_qvel = self._joints([f"{jaw}_joint" for jaw in jaws])
        self.num_grippers = len(jaws)
        self._check_actuators()
        self.contact_address = self._forces([contact_name(*pair) for pair in task.contact_pairs + task.force_pairs])
        self.collision_address = self._forces([collision_name(name) for name in task.obstacles])
        self._standing_height = self._find_standing_height()
        self._placements = tuple(self._placement(entry) for entry in task.objects)
        self.loose = tuple(entry.spec.name for entry in self._placements if entry.qpos_address is not None)
        self._riders = {
            carrier: tuple(self._free_joint(name) for name in names) for carrier, names in task.riders.items()
        }
        bodies = {model.body(index).name: ("body", index) for index in range(model.nbody)}
        sites = {model.site(index).name: ("site", index) for index in range(model.nsite)}
        self._frames = bodies | sites
        self._frames |= {alias: self._frames[name] for alias, name in FRAME_ALIASES.items()}
        placed = {entry.name for entry in task.objects}  # a support that is tracked too is placed as an object is
        self._supports = tuple(self._mocap_index(name) for name in task.supports if name not in placed)
        self._top = table_top(spec, task) if "scene" in variation.groups else None

    def frame(self, name: str) -> tuple[str, int]:
        """Return ("site" | "body", id) of a frame name.

        Raises:
            UnknownNameError: The model has no such body or site.
        """
        if name not in self._frames:
            raise UnknownNameError("frame", name, self._frames)
        return self._frames[name]

    def set_gains(self, stiffness: Sequence[float], damping: Sequence[float]) -> None:
        """Give the servos of ``g1.BODY_JOINTS`` their gains [Nm/rad, Nms/rad], in place."""
        self._gains = stiffness, damping
        for model in (self.model, self.physics, self.untouched):
            for joint, k, d in zip(g1.BODY_JOINTS, stiffness, damping, strict=True):
                servo = model.actuator(joint)
                servo.gainprm[0], servo.biasprm[1], servo.biasprm[2] = k, -k, -d

    def world_models(self, conditions: Conditions) -> tuple[mujoco.MjModel, mujoco.MjModel]:
        """Return ``physics`` and ``untouched`` of a world under some conditions.

        Raises:
            SceneError: The conditions are of a group that does not vary in this scene.
            UnknownNameError: The conditions are of an object that it does not have, or that is not loose.
        """
        if not conditions:
            return self.physics, self.untouched
        groups = self.variation.groups
        if lacking := sorted(conditions.groups() - set(groups)):
            got = f"a start with conditions of {', '.join(lacking)} in worlds of variation {self.variation.name!r}"
            raise SceneError(got, f"only those of {', '.join(groups) or 'no group'}", "name its variation")
        for name in sorted(conditions.objects() - set(self.loose)):
            raise UnknownNameError("condition of", name, self.loose)
        model = self._varied(conditions, drawn=False)
        for limb, joints in LIMBS.items():
            ratio = conditions.number("robot.gain", limb, plain=1.0)
            for joint in joints:
                servo, plain = model.actuator(joint), self.physics.actuator(joint)
                servo.gainprm[0] = plain.gainprm[0] * ratio
                servo.biasprm[1:3] = plain.biasprm[1:3] * ratio
        return model, _without_noslip(model)

    def shapes(self, conditions: Conditions) -> Shapes:
        """Return the shapes that a world has under some conditions, for drawing.

        Raises:
            SceneError: See ``world_models``.
        """
        if not conditions:
            return self._plain_shapes
        key = tuple(sorted(conditions.values.items()))
        if key not in self._known_shapes:
            if len(self._known_shapes) >= _SHAPES_KEPT:
                self._known_shapes.clear()
            self._known_shapes[key] = Shapes.of(self._varied(conditions, drawn=True))
        return self._known_shapes[key]

    def dress(self, conditions: Conditions) -> None:
        """Give the model, which worlds share, the shapes that one of them has, to draw it."""
        self.shapes(conditions).put_on(self.model)

    def _varied(self, conditions: Conditions, *, drawn: bool) -> mujoco.MjModel:
        """Compile the model of a world, with its visual geoms or without."""
        if self._specs is None:
            raise SceneError("a start with conditions in a plain scene", "a plain start", "name its variation")
        spec = self._specs[0 if drawn else 1].copy()
        try:
            resize_clutter(spec, conditions)
            vary(
                spec,
                self.physics,
                conditions,
                loose=self.loose,
                resizable=self._resizable(),
                supports=self.task.supports,
            )
            model = spec.compile()
            plain = self.model if drawn else self.physics
            if (model.nC, model.nM, model.ngeom) != (plain.nC, plain.nM, plain.ngeom):
                raise ValueError("it is laid out in another way than the plain model")
            return model
        except ValueError as error:
            raise SceneError(
                f"conditions under which {self.task.name} does not compile ({error})", "a sound model", "narrow them"
            ) from error

    def _resizable(self) -> tuple[str, ...]:
        """Return the loose objects whose size may change: of one body, with nothing inside."""
        parents = {int(self.model.body_parentid[index]) for index in range(self.model.nbody)}
        return tuple(name for name in self.loose if name not in self.task.riders and self._body(name).id not in parents)

    def size(self, name: str, conditions: Conditions) -> float:
        """Return the size of an object over its own under some conditions; 1 where it cannot change."""
        size = conditions.number("objects.size", name, plain=1.0)
        return size if size == 1.0 or name in self._resizable() else 1.0

    def place(self, initial_state: InitialState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Turn an initial state into positions of the robot, at rest on its feet, of objects and of their supports.

        Returns:
            qpos (nq,), mocap positions (nmocap, 3) [m], mocap quaternions (nmocap, 4) wxyz.

        Raises:
            SceneError: The state lacks "robot" or "object", or they are not three finite numbers each.
        """
        (x, y, yaw), model = _three_numbers(initial_state, "robot"), self.model
        conditions = Conditions.read(initial_state)
        offsets = self._offsets(initial_state, conditions)
        qpos = model.qpos0.copy()
        qpos[self.base_qpos : self.base_qpos + 7] = x, y, self._standing_height, *_yaw_quat(yaw)
        qpos[self.body_qpos] = g1.HOME
        mocap_bodies = np.argsort(model.body_mocapid, kind="stable")[model.nbody - model.nmocap :]
        mocap_pos = model.body_pos[mocap_bodies].copy()
        mocap_quat = model.body_quat[mocap_bodies].copy()
        for placement in self._placements:
            position, quat = self._placed(placement.spec, offsets)
            if placement.qpos_address is not None:
                position[2] += self._sunk(placement.spec.name, conditions)
                qpos[placement.qpos_address : placement.qpos_address + 7] = *position, *quat
            elif placement.mocap_index is not None:
                mocap_pos[placement.mocap_index], mocap_quat[placement.mocap_index] = position, quat
            if placement.spec.height_joint is not None:
                qpos[self._slide_address(placement.spec.height_joint)] = offsets.z
        for carrier, addresses in self._riders.items():
            entry = self.task.object(carrier)
            start, now = _pose(entry.position, entry.yaw), poses.pose(*self._placed(entry, offsets))
            for address in addresses:
                rider = poses.pose(model.qpos0[address : address + 3], model.qpos0[address + 3 : address + 7])
                qpos[address : address + 7] = np.concatenate(poses.split(now @ poses.invert(start) @ rider))
        for index in self._supports:
            mocap_pos[index, 1:] += offsets.y, offsets.z
            if offsets.x != 0.0:
                mocap_pos[index, 0] += offsets.x
        if self._top is not None:
            self._place_clutter(qpos, conditions, offsets)
        return qpos, mocap_pos, mocap_quat

    def _offsets(self, initial_state: InitialState, conditions: Conditions) -> "_Offsets":
        """Read how far objects are from their default poses.

        Raises:
            SceneError: A key is neither a start's nor an object's nor a condition's, or has not its numbers.
        """
        dy, dz, dyaw = _three_numbers(initial_state, "object")
        (dx,) = _numbers(initial_state, "object_x", 1) if "object_x" in initial_state else (0.0,)
        own = {}
        for key in initial_state.keys() - {"robot", "object", "object_x"} - conditions.values.keys():
            self.task.object(key)
            own[key] = _numbers(initial_state, key, 3)
        return _Offsets(x=dx, y=dy, z=self._height(dz, conditions), yaw=dyaw, own=own)

    def _height(self, dz: float, conditions: Conditions) -> float:
        """Return the offset in z [m] of objects and supports, no lower and no higher than the task's regions go."""
        shift = conditions.number("scene.height", plain=0.0)
        if shift == 0.0:
            return dz
        lowest = min([dz, *(region.object_z[0] for region in self.task.regions.values())])
        highest = max([dz, *(region.object_z[1] for region in self.task.regions.values())])
        return min(max(dz + shift, lowest), highest)

    def _sunk(self, name: str, conditions: Conditions) -> float:
        """Return by how much an object of another size begins higher so that it still lies on what carries it [m]."""
        size = self.size(name, conditions)
        return 0.0 if size == 1.0 else lowest_point(self.physics, name) * (1.0 - size)

    def _place_clutter(self, qpos: np.ndarray, conditions: Conditions, offsets: "_Offsets") -> None:
        """Put the cans on the table, moved by a region's offsets, or far away."""
        assert self._top is not None  # else there are none
        shift = np.array([offsets.x, offsets.y, offsets.z])
        addresses = [entry.qpos_address for entry in self._placements if entry.qpos_address is not None]
        middles = np.array([qpos[address : address + 2] for address in addresses]) - shift[:2]
        radii = np.array([self._radius(name) for name in self.loose])
        for name, place in place_clutter(conditions, self._top, middles, radii, self._facing(offsets)).items():
            address = self._free_joint(name)
            away = place[2] < self._top.centre[2]
            qpos[address : address + 7] = *(np.array(place) + (0.0 if away else shift)), 1.0, 0.0, 0.0, 0.0

    def _facing(self, offsets: "_Offsets") -> float:
        """Return by how many quarter turns [rad] the first object is turned, and with it the robot that handles it.

        Of turns after which the object looks the same, the least one counts.
        """
        entry = self.task.objects[0]
        if entry.symmetry == "any":
            return 0.0
        turn = (offsets.yaw if entry.placed else 0.0) + offsets.own.get(entry.name, (0.0, 0.0, 0.0))[2]
        least = min((float(poses.wrap_angle(turn + same)) for same in entry.symmetry), key=abs)
        return round(least / (math.pi / 2)) * math.pi / 2

    def _radius(self, name: str) -> float:
        """Return the radius of a circle around an object seen from above [m], with room for a larger size."""
        model, body = self.physics, self._body(name).id
        own = (model.geom_bodyid == body) & (model.geom_contype > 0)
        reach = np.abs(model.geom_pos[own, :2]) + model.geom_aabb[own, 3:5]
        return 1.15 * float(norm(reach.max(axis=0)))

    def _placed(self, entry: ObjectSpec, offsets: "_Offsets") -> tuple[np.ndarray, np.ndarray]:
        """Return position [m] and quaternion wxyz of an object moved by offsets."""
        if entry.moves_with is not None:
            carrier = self.task.object(entry.moves_with)
            now = poses.pose(*self._placed(carrier, offsets))
            return poses.split(
                now @ poses.invert(_pose(carrier.position, carrier.yaw)) @ _pose(entry.position, entry.yaw)
            )
        position, turn = np.array(entry.position), 0.0
        if entry.placed:
            position[1:] += offsets.y, 0.0 if entry.height_joint is not None else offsets.z
            turn = offsets.yaw
            if offsets.x != 0.0:
                position[0] += offsets.x
        if entry.name in offsets.own:
            dx, dy, dyaw = offsets.own[entry.name]
            position[:2] += dx, dy
            turn += dyaw
        return position, np.array(_yaw_quat(entry.yaw + turn))

    def _find_standing_height(self) -> float:
        """Return the height of the pelvis [m] at which the soles of the home pose touch the floor."""
        data = mujoco.MjData(self.model)
        data.qpos[self.body_qpos] = g1.HOME
        data.qpos[self.base_qpos : self.base_qpos + 7] = 0, 0, 0, 1, 0, 0, 0
        mujoco.mj_kinematics(self.model, data)
        points = [f"{side}_foot_point_{index}" for side in g1.SIDES for index in range(len(g1.FOOT_POINTS))]
        return g1.FOOT_POINT_RADIUS - min(float(data.geom(name).xpos[2]) for name in points)

    def _joints(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        joints = [self.model.joint(name) for name in names]
        addresses = [(joint.qposadr[0], joint.dofadr[0]) for joint in joints]
        columns = np.array(addresses, dtype=np.int64).reshape(-1, 2)
        return columns[:, 0].copy(), columns[:, 1].copy()

    def _check_actuators(self) -> None:
        found = [self.model.actuator(index).name for index in range(self.model.nu)]
        expected = list(actuator_names(self.task.hands))
        if found != expected:
            raise SceneError(f"actuators {found}", f"the robot's alone: {expected}", "let a task add none")

    def _forces(self, names: Sequence[str]) -> np.ndarray:
        starts = np.array([self.model.sensor(name).adr[0] for name in names], dtype=np.int64).reshape(-1, 1)
        return starts + 3 * np.arange(CONTACT_SLOTS)  # a contact force's first component is the normal one

    def _placement(self, spec: ObjectSpec) -> _Placement:
        address = self._free_joint_or_none(spec.name)
        if address is not None:
            return _Placement(spec, address, None)
        body = self._body(spec.name).id
        is_part = self.model.body_rootid[body] != body
        if is_part and not spec.placed:
            return _Placement(spec, None, None)
        return _Placement(spec, None, self._mocap_index(spec.name))

    def _free_joint(self, name: str) -> int:
        address = self._free_joint_or_none(name)
        if address is None:
            raise SceneError(f"a rider {name!r} that cannot be moved", "a free joint", "add_freejoint to it")
        return address

    def _free_joint_or_none(self, name: str) -> int | None:
        first = int(self._body(name).jntadr[0])
        free = first >= 0 and self.model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE
        return int(self.model.jnt_qposadr[first]) if free else None

    def _slide_address(self, name: str) -> int:
        found = {self.model.joint(index).name: index for index in range(self.model.njnt)}
        if name not in found or self.model.jnt_type[found[name]] != mujoco.mjtJoint.mjJNT_SLIDE:
            slides = [
                joint for joint, index in found.items() if self.model.jnt_type[index] == mujoco.mjtJoint.mjJNT_SLIDE
            ]
            raise UnknownNameError("slide joint", name, slides)
        return int(self.model.jnt_qposadr[found[name]])

    def _mocap_index(self, name: str) -> int:
        index = int(self._body(name).mocapid[0])
        if index < 0:
            raise SceneError(f"a body {name!r} that cannot be moved", "a free joint or a mocap body", "set mocap=True")
        return index

    def _body(self, name: str) -> mujoco._structs._MjModelBodyViews:
        try:
            return self.model.body(name)
        except KeyError:
            names = [self.model.body(index).name for index in range(self.model.nbody)]
            raise UnknownNameError("body", name, names) from None


def build_scene(task: Task, physics: Physics | None = None, variation: Variation = NONE) -> Scene:
    """Build and compile the scene of a task, whose worlds may differ as a variation says; arguments as ``Scene``."""
    return Scene(task, physics, variation)


def _without_noslip(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a model without the no-slip pass."""
    found = copy.copy(model)
    found.opt.noslip_iterations = 0
    return found


def _three_numbers(state: InitialState, key: str) -> tuple[float, float, float]:
    x, y, z = _numbers(state, key, 3)
    return x, y, z


def _numbers(state: InitialState, key: str, count: int) -> tuple[float, ...]:
    values = state.get(key)
    if values is None or len(values) != count or not all(math.isfinite(value) for value in values):
        expected = "'robot': [x, y, yaw] and 'object': [dy, dz, dyaw], finite numbers [m, rad]"
        raise SceneError(f"an initial state with {key}={values}", expected, "give all six numbers")
    return tuple(float(value) for value in values)


def _pose(position: tuple[float, float, float], yaw: float) -> np.ndarray:
    return poses.pose(np.array(position), np.array(_yaw_quat(yaw)))


def _yaw_quat(yaw: float) -> tuple[float, float, float, float]:
    return math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)

"""A command and a gait clock -> the closed-form reference joint targets that the whole-body policy corrects.

Standing: a planar two-link leg puts the soles under a pelvis at the commanded height, shifted by a quasi-static table
so that the centre of mass stays over the feet (the idea of AMO's adapter), and waist angles that turn the torso to
its commanded roll and pitch exactly. Walking: a clocked gait with foot placement from the velocity command and from
the velocity that leg odometry finds (Raibert). Open loop it falls within seconds; it is a starting point.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gym_demohlm.arithmetic import arcsin, arctan
from gym_demohlm.control import attitude, features, gait_clock, leg_ik
from gym_demohlm.control.arm_load import GRAVITY, ArmLoad
from gym_demohlm.control.settings import Gait, Settings
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

NUM_LOWER = len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS)  # the joints that the policy drives


SLEW = Settings().slew
WALK_HEIGHT = 0.60  # m: lowest while stepping
WALK_PITCH = (-0.3, 0.4)  # rad: torso pitch while stepping
WALK_YAW = 0.3  # rad: most turned while stepping
NEARLY_THERE = np.array([0.06, 0.1, 0.15, 0.2])  # m, rad, rad, rad: height, roll, pitch, yaw
# A squat is too deep to lean back in where the ankles end (0.87 rad) before the centre of mass is over the soles: it
# stays less than 3 cm behind their middle, arms at home, above this forward lean [rad], linear in height [m].
LEAN_BACK_HEIGHT, LEAN_BACK, LEAN_BACK_SLOPE = 0.40, 0.03, -2.2
LEAN_ASIDE = 0.70  # sine of the sideways lean that rolling a turned and bent torso may add up to: then the waist ends
UPRIGHT_ROLL = 0.1  # rad
OUTSIDE = np.array([0.05, 0.1, 0.1, 0.1, 0.1])  # m, rad: so far outside the postures of a walk the soles may turn
TURNS = np.array([joint.endswith("hip_yaw") for joint in features.DRIVEN_JOINTS])

# Grid of the quasi-static table and its axes: pelvis height [m] and forward lean of the torso [rad].
TABLE_HEIGHTS = np.linspace(0.40, 0.76, 10)
TABLE_PITCHES = np.linspace(-0.3, 1.2, 11)
LATERAL_SHIFT = 0.062  # m of pelvis shift for a sideways lean of the torso of sin = 1: measured on the model
# What the waist carries, weight times lever [Nm], arms at home: upwards and ahead (wbc.quasi_static.torso_load).
TORSO_LOAD_UP, TORSO_LOAD_AHEAD = 20.12, 1.57
# rad per Nm of arms held out ahead, hip pitch, knee, ankle pitch: a leg bears half, its knee is half-way to the ankle.
ARMS_SAG = np.array([0.5 / g1.motor("hip_pitch").stiffness, 0.25 / g1.motor("knee").stiffness, 0.0])
HIP_ROLL_SAG = 0.13  # rad: how far the pelvis hangs down from the one leg that bears it
WAIST_STIFFNESS = g1.motor("waist_pitch").stiffness
_HALF_PERIODS, _SIDES = np.array([0.0, 0.5]), np.array([1.0, -1.0])  # left, right foot
WIDENS = 0.25  # gait periods after the command stops in which the feet walk apart
LARGEST_TILT = 0.3  # rad, unplanned, that legs make up for
_HIP_YAWS = [g1.LEG_JOINTS.index(f"{side}_hip_yaw") for side in g1.SIDES]
SOLE_MIDDLE = 0.035  # m, of a sole, ahead of its ankle


def admissible(goal: np.ndarray, current: np.ndarray, standing: np.ndarray) -> np.ndarray:
    """Return what of a command can be followed now: first stand, then bend; first rise, then walk.

    A robot that squats, bends or turns its torso far ignores velocities, and one that stands first gets nearly to the
    posture that goes with them; one that steps stays high and nearly upright; one that squats deeply does not lean
    back; one that bends to a side does not roll further down there.

    Args:
        goal: (N, 7 or more) command.
        current: (N, 7 or more) slewed command.
        standing: (N,) bool, whether the clock rests.

    Returns:
        (N, 7) the command to slew towards.
    """
    goal = goal[:, :7].copy()
    posture = current[:, 3:7]
    bent = (posture[:, 0] < WALK_HEIGHT - 0.01) | (posture[:, 2] > WALK_PITCH[1] + 0.02)
    bent |= (np.abs(posture[:, [1, 3]]) > [0.1, WALK_YAW + 0.05]).any(axis=1)
    on_its_way = (np.abs(goal[:, 3:] - posture) > NEARLY_THERE).any(axis=1)
    goal[bent | (standing & on_its_way), :3] = 0.0
    goal[:, 3:] = balanced(goal[:, 3:], current[:, 3])
    steps = ~standing
    goal[:, 3] = np.where(steps, np.maximum(goal[:, 3], WALK_HEIGHT), goal[:, 3])
    goal[:, 4] = np.where(steps, 0.0, goal[:, 4])
    goal[:, 5] = np.where(steps, np.clip(goal[:, 5], *WALK_PITCH), goal[:, 5])
    goal[:, 6] = np.where(steps, np.clip(goal[:, 6], -WALK_YAW, WALK_YAW), goal[:, 6])
    return goal


def balanced(torso: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the nearest torso that the feet can stay under, by its pitch and roll.

    Args:
        torso: (N, 4) height [m], roll, pitch and yaw [rad].
        height: (N,) where the torso is by now [m].

    Returns:
        (N, 4).
    """
    roll, pitch, yaw = torso[:, 1], torso[:, 2], torso[:, 3]
    # Up, for the torso, in the heading frame: (cos y tan p + sin y tan r, sin y tan p - cos y tan r, 1), about.
    furthest_back = LEAN_BACK + LEAN_BACK_SLOPE * (height - LEAN_BACK_HEIGHT)
    lowest = np.sin(furthest_back) / np.cos(furthest_back)
    ahead, aside = np.cos(yaw), np.sin(yaw)
    pitch = np.maximum(pitch, arctan((lowest - aside * (np.sin(roll) / np.cos(roll))) / ahead))
    further = arcsin(np.clip((LEAN_ASIDE - np.abs(aside) * np.sin(pitch)) / ahead, 0.0, 1.0))
    roll = np.where(aside > 0, np.maximum(roll, -further), np.minimum(roll, further))
    return np.stack([torso[:, 0], roll, pitch, yaw], axis=1)


def action_scale(standing: np.ndarray, torso: np.ndarray) -> np.ndarray:
    """Return what an action of one adds to the joint targets.

    A robot that stands as it walks, nearly upright, does not turn its soles under its weight: whichever bears more
    would turn the whole robot.

    Args:
        standing: (N,) bool, whether the clock rests.
        torso: (N, 4) height [m], roll, pitch and yaw [rad], slewed.

    Returns:
        (N, 15) [rad].
    """
    outside = np.stack(
        [
            WALK_HEIGHT - torso[:, 0],
            np.abs(torso[:, 1]) - UPRIGHT_ROLL,
            torso[:, 2] - WALK_PITCH[1],
            WALK_PITCH[0] - torso[:, 2],
            np.abs(torso[:, 3]) - WALK_YAW,
        ]
    )
    turns = np.where(standing, np.clip((outside / OUTSIDE[:, None]).max(axis=0), 0.0, 1.0), 1.0)
    return np.where(TURNS, turns[:, None] * features.ACTION_SCALE, features.ACTION_SCALE)


def slew(current: np.ndarray, goal: np.ndarray, rates: Sequence[float] = SLEW) -> np.ndarray:
    """Move the first seven numbers of a command towards their goal at a bounded rate, (N, 7) -> (N, 7)."""
    step = np.array(rates) * CONTROL_DT
    return current + np.clip(goal - current, -step, step)


def _cell(value: float, axis: np.ndarray) -> tuple[int, float, float]:
    """Return which interval of an even axis a value is in, where in it in [0, 1], and intervals a unit (0 outside)."""
    first, a_unit = float(axis[0]), (len(axis) - 1) / float(axis[-1] - axis[0])
    place = (value - first) * a_unit
    index = min(max(int(place), 0), len(axis) - 2)
    inside = 0.0 <= place <= len(axis) - 1
    return index, min(max(place - index, 0.0), 1.0), a_unit if inside else 0.0


class Footing(NamedTuple):
    """How a robot at rest stands.

    Attributes:
        ahead: (N,) ankles ahead of the pelvis, in its heading frame [m].
        aside: (N,) the middle between them to its left [m].
        tilt: (N,) pitch of the pelvis [rad].
        bank: (N,) its roll [rad].
    """

    ahead: np.ndarray
    aside: np.ndarray
    tilt: np.ndarray
    bank: np.ndarray


class Reference:
    """The targets of legs and waist: a pose, and how much further to aim because joints give under the robot's weight.

    Args:
        posture_table: (len(TABLE_HEIGHTS), len(TABLE_PITCHES), 5) how far [m] the ankles stand ahead of the hips, the
            pitch of the pelvis [rad], and how far hip pitch, knee and ankle pitch give [rad].
        arm_table: What ``ArmLoad`` takes: how arms away from home shift the weight.
        gait: How it walks.

    Attributes:
        ahead: (len(TABLE_HEIGHTS), len(TABLE_PITCHES)) how far ahead of its ankles the pelvis is, arms at home [m].
    """

    def __init__(self, posture_table: np.ndarray, arm_table: np.ndarray, gait: Gait = gait_clock.GAIT) -> None:
        self.gait = gait
        self.posture_table = np.array(posture_table, dtype=np.float64)
        self.arm_load = ArmLoad(arm_table)
        shift, tilt = self.posture_table[..., 0], self.posture_table[..., 1]
        self.ahead = g1.HIP_DROP * np.sin(tilt) - shift

    def statics(self, height: np.ndarray, pitch: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Interpolate the table: heights, forward leans (N,) -> ankle shift, pelvis pitch (N,), sag of a leg (N, 3)."""
        row = np.clip(
            (height - TABLE_HEIGHTS[0]) / (TABLE_HEIGHTS[1] - TABLE_HEIGHTS[0]), 0, len(TABLE_HEIGHTS) - 1.001
        )
        column = np.clip(
            (pitch - TABLE_PITCHES[0]) / (TABLE_PITCHES[1] - TABLE_PITCHES[0]), 0, len(TABLE_PITCHES) - 1.001
        )
        i, j = row.astype(int), column.astype(int)
        u, v = row - i, column - j
        u, v, table = u[:, None], v[:, None], self.posture_table
        found = (1 - u) * ((1 - v) * table[i, j] + v * table[i, j + 1]) + u * (
            (1 - v) * table[i + 1, j] + v * table[i + 1, j + 1]
        )
        return found[:, 0], found[:, 1], found[:, 2:]

    def pelvis_ahead(self, height: float, pitch: float) -> tuple[float, float, float]:
        """Return how far ahead of its ankles the pelvis of a standing robot is: it backs off as the torso bends.

        Args:
            height: [m].
            pitch: [rad].

        Returns:
            The distance [m], and its derivatives by height [m/m] and by pitch [m/rad].
        """
        (i, u, rows), (j, v, columns) = _cell(height, TABLE_HEIGHTS), _cell(pitch, TABLE_PITCHES)
        (a, b), (c, d) = self.ahead[i, j : j + 2], self.ahead[i + 1, j : j + 2]
        low, high = a + v * (b - a), c + v * (d - c)
        return low + u * (high - low), (high - low) * rows, ((b - a) + u * (d - c - b + a)) * columns

    def arms_moment(self, command: np.ndarray, arms: np.ndarray, carried: np.ndarray) -> np.ndarray:
        """Return the moment [kg m] that arms and loads add to empty arms at home, seen along the torso's yaw.

        Args:
            command: (N, 7 or more), of which the torso's roll and pitch count.
            arms: (N, 8) the arms' joint targets but the wrists' [rad].
            carried: (N, 2) in the left and the right hand [kg].

        Returns:
            (N, 2) ahead and to the left.
        """
        roll, pitch = np.ascontiguousarray(command[:, 4:6].T)
        x, y, z = np.ascontiguousarray(self.arm_load(arms, carried).T)
        across = np.sin(roll) * y + np.cos(roll) * z
        return np.stack([np.cos(pitch) * x + np.sin(pitch) * across, np.cos(roll) * y - np.sin(roll) * z], axis=1)

    def __call__(
        self,
        command: np.ndarray,
        clock: gait_clock.Clock,
        velocity: np.ndarray,
        arms: np.ndarray,
        carried: np.ndarray,
        attitude_now: np.ndarray,
    ) -> np.ndarray:
        """Return the joint targets of legs and waist, ``pose`` and ``sag``, (N, 15) [rad].

        Args:
            command: As in ``pose``.
            clock: As in ``pose``.
            velocity: As in ``pose``.
            arms: (N, 8) the arms' joint targets but the wrists' [rad].
            carried: (N, 2) in the left and the right hand [kg].
            attitude_now: As in ``pose``.
        """
        moment = self.arms_moment(command, arms, carried)
        sag = self.sag(command, clock.phase, clock.standing, moment)
        return self.pose(command, clock, velocity, moment, attitude_now) + sag

    def footing(self, command: np.ndarray, moment: np.ndarray) -> Footing:
        """Return where the feet of a robot at rest should be, and how its pelvis leans; arguments as in ``pose``."""
        # Columns in one piece: NumPy may round a sine of a strided part otherwise.
        height, roll, pitch, yaw = np.ascontiguousarray(command[:, 3:7].T)
        forward, right = attitude.lean(roll, pitch, yaw)
        shift, tilt, _ = self.statics(height, forward)
        tilt, bank = attitude.pelvis_attitude(forward, right, tilt)
        offset = moment / g1.MASS
        shift = shift + np.cos(yaw) * offset[:, 0] - np.sin(yaw) * offset[:, 1]
        aside = np.sin(yaw) * offset[:, 0] + np.cos(yaw) * offset[:, 1] - LATERAL_SHIFT * np.sin(right)
        return Footing(shift - g1.HIP_DROP * np.sin(tilt), aside, tilt, bank)

    def pose(
        self,
        command: np.ndarray,
        clock: gait_clock.Clock,
        velocity: np.ndarray,
        moment: np.ndarray,
        attitude_now: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the joint positions of legs and waist.

        Args:
            command: (N, 7 or more) velocity, torso height, roll, pitch, yaw.
            clock: Of the gait.
            velocity: (N, 2) of the pelvis in the heading frame, from the odometry [m/s].
            moment: (N, 2) of the arms, from ``arms_moment`` [kg m].
            attitude_now: (N, 4) pitch and roll of the pelvis [rad] and their rates [rad/s]; as planned by default.

        Returns:
            (N, 15) [rad], in the order of ``g1.BODY_JOINTS``.
        """
        gait, (phase, stopped, standing, recovers) = self.gait, clock
        vx, vy, yaw_rate, height, roll, pitch, yaw = np.ascontiguousarray(command[:, :7].T)
        ahead, aside, tilt, bank = self.footing(command, moment)
        walking = ~standing
        targets = np.zeros((len(command), NUM_LOWER))
        half_stride = 0.5 * (1 - gait.swing) * gait_clock.period(recovers, gait)[:, None]  # s: mid-stance to lift-off
        sway = np.where(walking, gait.sway * np.sin(2 * np.pi * (phase + 0.05)), 0.0)
        extra = np.clip(velocity - command[:, :2], -0.6, 0.6) * gait.placement_s
        own = (phase[:, None] + _HALF_PERIODS) % 1.0  # (N, 2), left and right
        u = np.clip(own / gait.swing, 0, 1)
        v = (own - gait.swing) / (1 - gait.swing)
        eased, walks = u * u * (3 - 2 * u), walking[:, None]
        swings = own < gait.swing
        progress = np.where(walks, np.where(swings, -1 + 2 * eased, 1 - 2 * v), 0.0) * half_stride
        reach = np.where(walks, np.where(swings, eased, 1 - v), 0.0)
        lift = np.where(swings & walks, gait.lift * np.sin(np.pi * u) ** 2, 0.0)
        spread = gait_clock.spread(recovers, gait)
        apart = spread + (g1.HIP_SPREAD - spread) * np.minimum(stopped / WIDENS, 1.0)
        beside = extra[:, 1:] * np.where(extra[:, 1:] * _SIDES < 0, gait.inward, 1.0)
        out = np.where(walking, apart, g1.HIP_SPREAD) + np.where(walking, gait.widen * np.abs(vy), 0.0)
        ankles = leg_ik.Vectors(
            vx[:, None] * progress + extra[:, :1] * reach + ahead[:, None],
            vy[:, None] * progress + beside * reach + (sway + aside)[:, None] + out[:, None] * _SIDES,
            lift - height[:, None] + g1.SOLE_DROP,
        )
        tilts, banks = tilt[:, None], bank[:, None]
        unplanned = _unplanned(attitude_now, tilt, bank)
        if gait.swing_upright:
            share = gait.swing_upright * np.where(walks, np.where(swings, eased, np.maximum(1 - 4 * v, 0.0)), 0.0)
            tilts, banks = tilts + share * unplanned[:, :1], banks + share * unplanned[:, 1:2]
        legs = leg_ik.solve(ankles, yaw_rate[:, None] * progress, tilts, banks)
        if gait.ankle_upright or gait.ankle_damping_s:
            against = gait.ankle_upright * unplanned[:, :2] + gait.ankle_damping_s * unplanned[:, 2:]
            legs[..., 4:] += np.where(swings & walks, 0.0, 1.0)[..., None] * against[:, None]
        targets[:, :12] = legs.reshape(len(command), 12)
        if any(gait.turn):
            targets[:, _HIP_YAWS] += np.where(walking, _turn(gait.turn, phase, vx, vy, yaw_rate), 0.0)[:, None]
        targets[:, 12] = yaw
        targets[:, 13], targets[:, 14] = attitude.waist_angles(roll, pitch, yaw, tilt, bank)
        return targets

    def capture(
        self, command: np.ndarray, moment: np.ndarray, over_soles: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return where a robot at rest would come to a stop, from where its weight should be.

        The capture point of the linear inverted pendulum; the weight is as far from where it should be as the pelvis.

        Args:
            command: As in ``pose``.
            moment: As in ``pose``.
            over_soles: (N, 2) pelvis from the middle of the soles, in the heading frame [m].
            velocity: (N, 2) of the pelvis in the heading frame [m/s].

        Returns:
            (N, 2) ahead and to the left [m].
        """
        footing = self.footing(command, moment)
        planned = np.stack([-footing.ahead - SOLE_MIDDLE, -footing.aside], axis=1)
        return over_soles - planned + velocity * np.sqrt(command[:, 3:4] / GRAVITY)

    def sag(self, command: np.ndarray, phase: np.ndarray, standing: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Return how much further to aim because joints of finite stiffness give under the robot's weight.

        Args:
            command: (N, 7 or more) velocity, torso height, roll, pitch, yaw.
            phase: (N,) gait clock.
            standing: (N,) bool.
            moment: (N, 2) of the arms, from ``arms_moment`` [kg m].

        Returns:
            (N, 15) [rad]. Of the weight a leg bears half while standing, all of it while the other swings.
        """
        height, roll, pitch, yaw = np.ascontiguousarray(command[:, 3:7].T)
        _, _, legs = self.statics(height, attitude.lean(roll, pitch, yaw)[0])
        ahead, aside = GRAVITY * moment.T  # Nm
        legs = legs + (np.cos(yaw) * ahead - np.sin(yaw) * aside)[:, None] * ARMS_SAG
        own = (phase[:, None] + _HALF_PERIODS) % 1.0  # (N, 2), left and right
        alone = np.minimum(np.minimum(own - self.gait.swing, 1 - own) / (0.5 - self.gait.swing), 1.0)
        bears = np.where(standing[:, None], 1.0, 2 * np.maximum(alone, 0.0))
        further = np.zeros((len(command), NUM_LOWER))
        sides = further[:, :12].reshape(-1, 2, 6)
        sides[:, :, [0, 3, 4]] = bears[:, :, None] * legs[:, None]
        sides[:, :, 1] = _SIDES * HIP_ROLL_SAG * np.maximum(bears - 1, 0)
        further[:, 13] = (aside - TORSO_LOAD_UP * np.sin(roll)) / WAIST_STIFFNESS
        load_ahead = TORSO_LOAD_UP * np.sin(pitch) + TORSO_LOAD_AHEAD * np.cos(pitch)
        further[:, 14] = -(ahead + load_ahead) / WAIST_STIFFNESS
        return further


class Rest(Reference):
    """The pose of rest whatever the command: what a policy corrects that was trained without a reference."""

    def pose(
        self,
        command: np.ndarray,
        clock: gait_clock.Clock,
        velocity: np.ndarray,
        moment: np.ndarray,
        attitude_now: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the joint positions at rest; arguments as in the base class."""
        return np.tile(g1.HOME[:NUM_LOWER], (len(command), 1))

    def sag(self, command: np.ndarray, phase: np.ndarray, standing: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Return that it aims no further; arguments as in the base class."""
        return np.zeros((len(command), NUM_LOWER))


def _unplanned(attitude_now: np.ndarray | None, tilt: np.ndarray, bank: np.ndarray) -> np.ndarray:
    """Return how pitch and roll of a pelvis (N, 4) differ from those planned, bounded, and their rates, (N, 4)."""
    if attitude_now is None:
        return np.zeros((len(tilt), 4))
    off = np.clip(attitude_now[:, :2] - np.stack([tilt, bank], axis=1), -LARGEST_TILT, LARGEST_TILT)
    return np.concatenate([off, np.clip(attitude_now[:, 2:], -3.0, 3.0)], axis=1)


def _turn(
    coefficients: Sequence[float], phase: np.ndarray, vx: np.ndarray, vy: np.ndarray, yaw_rate: np.ndarray
) -> np.ndarray:
    """Return what hip yaws add (N,) [rad]; see ``Gait.turn``."""
    angle = 2 * np.pi * phase
    (c1, s1), (c2, s2), (c3, s3) = ((np.cos(n * angle), np.sin(n * angle)) for n in (1, 2, 3))
    odd, even = (c1, s1, c3, s3), (c2, s2)
    terms = [*odd, *(vx * wave for wave in odd), *(vy * wave for wave in even), *(yaw_rate * wave for wave in even)]
    total = np.zeros_like(phase)
    for coefficient, term in zip(coefficients, terms, strict=True):
        total = total + coefficient * term
    return total

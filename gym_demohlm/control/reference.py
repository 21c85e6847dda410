"""A command and a gait clock -> the closed-form reference joint targets that the whole-body policy corrects.

Standing: a planar two-link leg puts the soles under a pelvis at the commanded height, shifted by a quasi-static table
so that the centre of mass stays over the feet (the idea of AMO's adapter), and waist angles that turn the torso to
its commanded roll and pitch exactly. Walking: a clocked gait with foot placement from the velocity command and from
the velocity that leg odometry finds (Raibert). Open loop it falls within seconds; it is a starting point.
"""

from dataclasses import dataclass

import numpy as np

from gym_demohlm.arithmetic import arcsin, arctan
from gym_demohlm.control import attitude, features, leg_ik
from gym_demohlm.control.arm_load import GRAVITY, ArmLoad
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

NUM_LOWER = len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS)  # the joints that the policy drives


@dataclass(frozen=True, kw_only=True)
class Gait:
    """The walking reference.

    Attributes:
        period_s: Time of two steps [s].
        swing: Part of the period in which a foot is in the air; the right foot swings half a period after the left.
        lift: Height of the sole at mid-swing [m].
        sway: Amplitude of the lateral sway of the pelvis [m].
        widen: How much wider each foot stands for a sideways speed [m per m/s], so that the feet never cross.
        placement_s: Feet land this much further out for a velocity error [m per m/s]: Raibert's foot placement.
    """

    period_s: float = 0.64
    swing: float = 0.4
    lift: float = 0.06
    sway: float = 0.025
    widen: float = 0.06
    placement_s: float = 0.12


GAIT = Gait()
# The clock rests just before a swing, where both feet are on the floor.
REST_PHASES = (0.5 * (0.5 + GAIT.swing), 0.5 + 0.5 * (0.5 + GAIT.swing))
WALK_THRESHOLD = np.array([0.04, 0.04, 0.08])  # m/s, m/s, rad/s: slower commands mean "stand"
SLEW = np.array([1.5, 1.5, 3.0, 0.4, 1.2, 1.2, 1.5])  # fastest change of the command's first seven numbers, per second
WALK_HEIGHT = 0.60  # m: lowest while stepping
WALK_PITCH = (-0.3, 0.4)  # rad: torso pitch while stepping
WALK_YAW = 0.3  # rad: most turned while stepping
_NEARLY_THERE = np.array([0.06, 0.1, 0.15, 0.2])  # m, rad, rad, rad: height, roll, pitch, yaw
# A squat is too deep to lean back in where the ankles end (0.87 rad) before the centre of mass is over the soles: it
# stays less than 3 cm behind their middle, arms at home, above this forward lean [rad], linear in height [m].
LEAN_BACK_HEIGHT, LEAN_BACK, LEAN_BACK_SLOPE = 0.40, 0.03, -2.2
LEAN_ASIDE = 0.70  # sine of the sideways lean that rolling a turned and bent torso may add up to: then the waist ends
_UPRIGHT_ROLL = 0.1  # rad
_OUTSIDE = np.array([0.05, 0.1, 0.1, 0.1, 0.1])  # m, rad: so far outside the postures of a walk the soles may turn
_TURNS = np.array([joint.endswith("hip_yaw") for joint in features.DRIVEN_JOINTS])
STEPS_TO_SQUARE_UP = 1.0  # gait periods walked in place after the command stops, so that both feet end under the hips
# A robot at rest takes steps when its pelvis moves faster than its feet can hold [m/s], or tips over its soles [rad].
STARTLE_SPEED, STARTLE_TILT = np.array([0.25, 0.35]), 0.2

# Grid of the quasi-static table and its axes: pelvis height [m] and forward lean of the torso [rad].
TABLE_HEIGHTS = np.linspace(0.40, 0.76, 10)
TABLE_PITCHES = np.linspace(-0.3, 1.2, 11)
LATERAL_SHIFT = 0.062  # m of pelvis shift for a sideways lean of the torso of sin = 1: measured on the model
# What the waist carries, weight times lever [Nm], arms at home: upwards and ahead (wbc.quasi_static.torso_load).
TORSO_LOAD_UP, TORSO_LOAD_AHEAD = 20.12, 1.57
# rad per Nm of arms held out ahead, hip pitch, knee, ankle pitch: a leg bears half, its knee is half-way to the ankle.
_ARMS_SAG = np.array([0.5 / g1.motor("hip_pitch").stiffness, 0.25 / g1.motor("knee").stiffness, 0.0])
HIP_ROLL_SAG = 0.13  # rad: how far the pelvis hangs down from the one leg that bears it
_WAIST_STIFFNESS = g1.motor("waist_pitch").stiffness
_HALF_PERIODS, _SIDES = np.array([0.0, 0.5]), np.array([1.0, -1.0])  # left, right foot
_BOTH_DOWN = 0.5 - GAIT.swing  # part of the period from a foot's touch-down to the other's lift-off


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
    on_its_way = (np.abs(goal[:, 3:] - posture) > _NEARLY_THERE).any(axis=1)
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
            np.abs(torso[:, 1]) - _UPRIGHT_ROLL,
            torso[:, 2] - WALK_PITCH[1],
            WALK_PITCH[0] - torso[:, 2],
            np.abs(torso[:, 3]) - WALK_YAW,
        ]
    )
    turns = np.where(standing, np.clip((outside / _OUTSIDE[:, None]).max(axis=0), 0.0, 1.0), 1.0)
    return np.where(_TURNS, turns[:, None] * features.ACTION_SCALE, features.ACTION_SCALE)


def slew(current: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Move the first seven numbers of a command towards their goal at a bounded rate, (N, 7) -> (N, 7)."""
    step = SLEW * CONTROL_DT
    return current + np.clip(goal - current, -step, step)


def startled(velocity: np.ndarray, sole_tilt: np.ndarray) -> np.ndarray:
    """Return who must step to keep upright (N,) bool, from the odometry: velocity (N, 2) and sole tilt (N,)."""
    return (np.abs(velocity) > STARTLE_SPEED).any(axis=1) | (sole_tilt > STARTLE_TILT)


def advance_clock(
    phase: np.ndarray, stopped: np.ndarray, standing: np.ndarray, velocity: np.ndarray, startled: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Advance the gait clock by one control tick.

    Args:
        phase: (N,) in [0, 1).
        stopped: (N,) gait periods since the command, or a loss of balance, last asked for steps.
        standing: (N,) bool, whether the clock rests.
        velocity: (N, 3) commanded velocity.
        startled: (N,) bool, who loses balance.

    Returns:
        The new phase, stopped and standing.
    """
    tick = CONTROL_DT / GAIT.period_s
    walk = (np.abs(velocity) > WALK_THRESHOLD).any(axis=1) | startled
    stopped = np.where(walk, 0.0, np.minimum(stopped + tick, 10.0))
    moved = (phase + tick) % 1.0
    both_down = (moved % 0.5) >= GAIT.swing
    stands = ~walk & (standing | ((stopped >= STEPS_TO_SQUARE_UP) & both_down))
    rest = np.where(standing, phase, np.where(moved < 0.5, REST_PHASES[0], REST_PHASES[1]))
    return np.where(stands, rest, moved), stopped, stands


def _cell(value: float, axis: np.ndarray) -> tuple[int, float, float]:
    """Return which interval of an even axis a value is in, where in it in [0, 1], and intervals a unit (0 outside)."""
    first, a_unit = float(axis[0]), (len(axis) - 1) / float(axis[-1] - axis[0])
    place = (value - first) * a_unit
    index = min(max(int(place), 0), len(axis) - 2)
    inside = 0.0 <= place <= len(axis) - 1
    return index, min(max(place - index, 0.0), 1.0), a_unit if inside else 0.0


def swing_state(phase: np.ndarray, standing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which feet should be in the air (N, 2) bool and how high their soles should be (N, 2) [m]; left, right."""
    own = (phase[:, None] + np.array([0.0, 0.5])) % 1.0
    swing = (own < GAIT.swing) & ~standing[:, None]
    return swing, np.where(swing, GAIT.lift * np.sin(np.pi * own / GAIT.swing) ** 2, 0.0)


class Reference:
    """The targets of legs and waist: a pose, and how much further to aim because joints give under the robot's weight.

    Args:
        posture_table: (len(TABLE_HEIGHTS), len(TABLE_PITCHES), 5) how far [m] the ankles stand ahead of the hips, the
            pitch of the pelvis [rad], and how far hip pitch, knee and ankle pitch give [rad].
        arm_table: What ``ArmLoad`` takes: how arms away from home shift the weight.
    """

    def __init__(self, posture_table: np.ndarray, arm_table: np.ndarray) -> None:
        self.posture_table = np.array(posture_table, dtype=np.float64)
        self.arm_load = ArmLoad(arm_table)
        shift, tilt = self.posture_table[..., 0], self.posture_table[..., 1]
        # Lists: a few numbers at a time are sooner found in them.
        self._ahead = (g1.HIP_DROP * np.sin(tilt) - shift).tolist()

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
        (a, b), (c, d) = self._ahead[i][j : j + 2], self._ahead[i + 1][j : j + 2]
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
        phase: np.ndarray,
        standing: np.ndarray,
        velocity: np.ndarray,
        arms: np.ndarray,
        carried: np.ndarray,
    ) -> np.ndarray:
        """Return the joint targets of legs and waist, ``pose`` and ``sag``, (N, 15) [rad].

        Args:
            command: As in ``pose``.
            phase: As in ``pose``.
            standing: As in ``pose``.
            velocity: As in ``pose``.
            arms: (N, 8) the arms' joint targets but the wrists' [rad].
            carried: (N, 2) in the left and the right hand [kg].
        """
        moment = self.arms_moment(command, arms, carried)
        return self.pose(command, phase, standing, velocity, moment) + self.sag(command, phase, standing, moment)

    def pose(
        self, command: np.ndarray, phase: np.ndarray, standing: np.ndarray, velocity: np.ndarray, moment: np.ndarray
    ) -> np.ndarray:
        """Return the joint positions of legs and waist.

        Args:
            command: (N, 7 or more) velocity, torso height, roll, pitch, yaw.
            phase: (N,) gait clock.
            standing: (N,) bool.
            velocity: (N, 2) of the pelvis in the heading frame, from the odometry [m/s].
            moment: (N, 2) of the arms, from ``arms_moment`` [kg m].

        Returns:
            (N, 15) [rad], in the order of ``g1.BODY_JOINTS``.
        """
        # Columns in one piece: NumPy may round a sine of a strided part otherwise.
        vx, vy, yaw_rate, height, roll, pitch, yaw = np.ascontiguousarray(command[:, :7].T)
        forward, right = attitude.lean(roll, pitch, yaw)
        shift, tilt, _ = self.statics(height, forward)
        tilt, bank = attitude.pelvis_attitude(forward, right, tilt)
        offset = moment / g1.MASS
        shift = shift + np.cos(yaw) * offset[:, 0] - np.sin(yaw) * offset[:, 1]
        aside = np.sin(yaw) * offset[:, 0] + np.cos(yaw) * offset[:, 1] - LATERAL_SHIFT * np.sin(right)
        walking = ~standing
        targets = np.zeros((len(command), NUM_LOWER))
        half_stride = 0.5 * (1 - GAIT.swing) * GAIT.period_s  # s: from mid-stance to lift-off
        sway = np.where(walking, GAIT.sway * np.sin(2 * np.pi * (phase + 0.05)), 0.0)
        extra = np.clip(velocity - command[:, :2], -0.6, 0.6) * GAIT.placement_s
        own = (phase[:, None] + _HALF_PERIODS) % 1.0  # (N, 2), left and right
        u = np.clip(own / GAIT.swing, 0, 1)
        v = (own - GAIT.swing) / (1 - GAIT.swing)
        eased, walks = u * u * (3 - 2 * u), walking[:, None]
        swings = own < GAIT.swing
        progress = np.where(walks, np.where(swings, -1 + 2 * eased, 1 - 2 * v), 0.0) * half_stride
        reach = np.where(walks, np.where(swings, eased, 1 - v), 0.0)
        lift = np.where(swings & walks, GAIT.lift * np.sin(np.pi * u) ** 2, 0.0)
        out = g1.HIP_SPREAD + np.where(walking, GAIT.widen * np.abs(vy), 0.0)
        ankles = leg_ik.Vectors(
            vx[:, None] * progress + extra[:, :1] * reach + (shift - g1.HIP_DROP * np.sin(tilt))[:, None],
            vy[:, None] * progress + extra[:, 1:] * reach + (sway + aside)[:, None] + out[:, None] * _SIDES,
            lift - height[:, None] + g1.SOLE_DROP,
        )
        legs = leg_ik.solve(ankles, yaw_rate[:, None] * progress, tilt, bank)
        targets[:, :12] = legs.reshape(len(command), 12)
        targets[:, 12] = yaw
        targets[:, 13], targets[:, 14] = attitude.waist_angles(roll, pitch, yaw, tilt, bank)
        return targets

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
        legs = legs + (np.cos(yaw) * ahead - np.sin(yaw) * aside)[:, None] * _ARMS_SAG
        own = (phase[:, None] + _HALF_PERIODS) % 1.0  # (N, 2), left and right
        alone = np.minimum(np.minimum(own - GAIT.swing, 1 - own) / _BOTH_DOWN, 1.0)
        bears = np.where(standing[:, None], 1.0, 2 * np.maximum(alone, 0.0))
        further = np.zeros((len(command), NUM_LOWER))
        sides = further[:, :12].reshape(-1, 2, 6)
        sides[:, :, [0, 3, 4]] = bears[:, :, None] * legs[:, None]
        sides[:, :, 1] = _SIDES * HIP_ROLL_SAG * np.maximum(bears - 1, 0)
        further[:, 13] = (aside - TORSO_LOAD_UP * np.sin(roll)) / _WAIST_STIFFNESS
        load_ahead = TORSO_LOAD_UP * np.sin(pitch) + TORSO_LOAD_AHEAD * np.cos(pitch)
        further[:, 14] = -(ahead + load_ahead) / _WAIST_STIFFNESS
        return further

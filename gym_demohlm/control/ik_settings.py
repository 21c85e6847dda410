"""What the inverse kinematics of the upper body weighs against what, and how fast it may go."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class IKSettings:
    """Rates, weights and effort of the solver. Weights multiply squared errors in metres and radians.

    Attributes:
        height_rate: Fastest change of the torso height [m/s].
        torso_rate: Fastest change of torso roll, pitch and yaw [rad/s].
        arm_rate: Fastest change of an arm joint [rad/s].
        torso_position_weight: Pull of a palm to its target position, in the torso pass.
        arm_position_weight: The same in the arm pass; high, so that an orientation out of reach costs no position.
        torso_orientation_weight: Pull of a palm to its target orientation, in the torso pass.
        arm_orientation_weight: The same in the arm pass.
        height_weight: Pull of the torso height to `g1.PELVIS_HEIGHT`.
        pitch_weight: Pull of the torso to upright; weak, so that low targets bend it before they bend the knees.
        yaw_weight: Pull of the torso yaw to straight ahead.
        roll_weight: Pull of the torso roll to zero.
        head_weight: Pull of the head to its target position, in the torso pass; the gaze controller turns it.
        highest: Torso height beyond which it does not rise [m], if the command's bound is not lower.
        furthest_back: Torso pitch beyond which it does not lean back [rad]: no target in front needs it.
        straightest_elbow: Elbow angle that the torso pass counts on at most [rad] (straight is about 1.6): what is left
            makes up for a torso that does not get all the way.
        torso_posture_weight: Pull of the arms to the home posture, in the torso pass.
        arm_posture_weight: The same in the arm pass; it chooses the elbow's height.
        regularization: Damping of each step.
        error_damping: More of it, times the hands' weighted squared error.
        iterations: Linearisations a pass, at most.
        converged: A change of all joints by less than this [rad, m] is the last one.
    """

    height_rate: float = 0.3
    torso_rate: float = 0.8
    arm_rate: float = 4.0
    torso_position_weight: float = 10.0
    arm_position_weight: float = 50.0
    torso_orientation_weight: float = 0.05
    arm_orientation_weight: float = 0.5
    height_weight: float = 0.5
    pitch_weight: float = 0.05
    yaw_weight: float = 0.1
    roll_weight: float = 1.0
    head_weight: float = 1.0
    highest: float = math.inf
    furthest_back: float = -0.1
    straightest_elbow: float = 1.0
    torso_posture_weight: float = 0.001
    arm_posture_weight: float = 0.001
    regularization: float = 2e-3
    error_damping: float = 1.5
    iterations: int = 2
    converged: float = 0.01

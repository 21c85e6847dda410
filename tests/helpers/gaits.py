"""Walking references that tests try: the first controller's, and one in which every part does something."""

import numpy as np

from gym_demohlm.control.settings import Gait

GAITS = {
    "first": Gait(),
    "every part of it": Gait(
        inward=0.3,
        recovery_s=2.5,
        recovery_speed=0.2,
        recovery_spread=0.13,
        recovery_period_s=0.5,
        spread=0.08,
        swing_upright=0.6,
        ankle_upright=0.5,
        ankle_damping_s=0.05,
        turn=tuple(0.01 * np.arange(1, 13)),
        capture=(0.095, 0.085, 0.135),
    ),
}
"""What it is -> its settings."""

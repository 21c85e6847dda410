"""How time is divided: physics and PD at 500 Hz, whole-body controller at 50 Hz, policy and environment at 10 Hz."""

PHYSICS_DT = 0.002  # s
CONTROL_DT = 0.02  # s, one tick of the whole-body controller
TICKS = 5  # controller ticks a step
STEP_DT = CONTROL_DT * TICKS  # s, one step of environment and policy
FPS = 10  # steps a second: the rate of datasets and films

"""How time is divided: physics and PD at 500 Hz, whole-body controller at 50 Hz, policy and environment at 10 Hz."""

PHYSICS_DT = 0.002  # s, one step of MuJoCo and of the joint PD (paper, "Hardware Design")
CONTROL_DT = 0.02  # s, one tick of the whole-body controller
TICKS = 5  # controller ticks a step
STEP_DT = CONTROL_DT * TICKS  # s, one step of environment and policy
FPS = round(1 / STEP_DT)  # steps a second: the rate of datasets and films
HOLD_S = 1.0  # s that success must last to count
HOLD_STEPS = round(HOLD_S / STEP_DT)
STAND_S = 2.0  # s that the robot must stand after a strict success
STAND_STEPS = round(STAND_S / STEP_DT)

"""Limits of the servo that drives the neck and the grippers, from its data sheet, as seen at the joint.

Dynamixel XC330-M288-T at 5 V (https://emanual.robotis.com/docs/en/dxl/x/xc330-m288/); the paper, appendix "Hardware".
"""

import math

STALL_TORQUE = 0.93  # Nm
NO_LOAD_SPEED = 81 * 2 * math.pi / 60  # rad/s
MASS = 0.023  # kg
SIZE = (0.020, 0.034, 0.026)  # m
GEAR_RATIO = 288.35
ROTOR_INERTIA = 1.2e-8  # kg m^2: not published; estimated for a coreless rotor of about 3 g and 3 mm radius
ARMATURE = ROTOR_INERTIA * GEAR_RATIO**2  # kg m^2 at the output shaft
BACK_EMF_DAMPING = STALL_TORQUE / NO_LOAD_SPEED  # Nms/rad: slope of the torque-speed line, a passive joint damping

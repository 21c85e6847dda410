"""How little the numbers of a dataset in memory may spread, in each dimension's own unit (rad, rad/s, m, ...).

A gripper that never moves has a deviation of 1e-8 and a range of 1e-6: LeRobot's policies, which divide by one or the
other, would see a milliradian of it as 1e5 or 2e3.
"""

STD_FLOOR = 0.01
"""Of standard deviations."""
RANGE_FLOOR = 2 * STD_FLOOR
"""From the least to the greatest number of an observation."""

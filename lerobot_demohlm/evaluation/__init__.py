"""Policies rolled out: seeded episodes, success rates, and the environment as LeRobot configures it."""

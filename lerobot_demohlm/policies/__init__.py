"""LeRobot policies of this package and how they are trained; ``lerobot_demohlm.register`` makes them known to it."""

"""From commands to joint targets: the whole-body controller, gaze and inverse kinematics."""

"""The G1: its motors, hands, neck and kinematic description."""

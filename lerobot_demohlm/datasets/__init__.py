"""Generated episodes as LeRobot datasets: written, merged, read again and pushed."""

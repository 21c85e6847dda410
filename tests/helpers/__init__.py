"""What several tests need: made-up episodes and runs, stand-ins for controllers and workers."""

"""An operator's head and wrist poses at 10 Hz -> commands to the controller -> a recorded demonstration."""

"""One page for headsets, phones, gamepads, keyboards and onlookers <-> a recording session in real time."""

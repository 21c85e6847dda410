"""One demonstration -> any number of episodes: retargeted, played through the controller, judged and counted."""

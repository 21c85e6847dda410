"""Whether things are as they should be: datasets, tasks, and the bits of this machine."""

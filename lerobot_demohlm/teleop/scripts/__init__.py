"""One scripted operator a task, in a file named as the task's: a module with ``make_operator``."""

"""One file a task, each with a ``TASK`` value; ``gym_demohlm.task`` finds them by themselves."""

"""The paper's experiments: what is to be run, its running, and its numbers as tables and plots beside the paper's."""

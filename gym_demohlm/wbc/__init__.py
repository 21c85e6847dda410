"""Training of the whole-body controller by reinforcement learning (extra ``wbc``)."""

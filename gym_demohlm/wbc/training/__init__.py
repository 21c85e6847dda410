"""Training of the whole-body controller (extra ``wbc``)."""

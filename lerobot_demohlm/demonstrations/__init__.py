"""Recordings of an operator: made, kept, repeated bit for bit, and cut into segments at their contacts."""

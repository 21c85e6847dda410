"""The tasks as Gymnasium environments: observations, episodes, rendering."""

"""The command `microid`."""

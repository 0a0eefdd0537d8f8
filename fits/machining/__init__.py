"""What the dimensions of a stage and their tolerances do to its motion."""

"""Section 2 of the paper: what the dimensions of the stage make of its motion, and their errors of its accuracy."""

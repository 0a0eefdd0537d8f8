"""What makes a stage follow: inverse feedforward, tuned loops, and C for a controller."""

"""What a fitted stage gets wrong, which physical effect causes it, and what is gained by adding it."""

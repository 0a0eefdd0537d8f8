"""Pictures of what the other rooms computed."""

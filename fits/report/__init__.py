"""Texts, JSON and HTML of what the other rooms computed."""

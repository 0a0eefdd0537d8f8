"""Thousands to millions of simulations, sensitivities, fits and diagnoses: described, run in chunks, and resumed."""

"""The hysteresis alone, fitted to slow loops."""

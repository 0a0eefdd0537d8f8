"""A whole stage, fitted to slow and fast runs together; frequency responses; model files."""

"""Figures of residuals: noise, its correlation and spectrum, errors, and what data leave open."""

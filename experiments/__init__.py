"""Runnable experiments: `python -m experiments.NAME --help` from a clone's root."""

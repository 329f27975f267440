"""Hostile input by machine: `python -m fuzzing`; docs/fuzzing.md says what for."""

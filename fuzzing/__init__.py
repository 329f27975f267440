"""Hostile input made by machine: `python -m fuzzing`; see docs/fuzzing.md."""

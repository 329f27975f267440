"""Section 6 of Maurin 2009 again, simulated: what `stereoreg reproduce` runs. `run.py` is the file to read first."""

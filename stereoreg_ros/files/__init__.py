"""Files written whole, and files read within bounds."""

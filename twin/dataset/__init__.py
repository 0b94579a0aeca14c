"""Data sets as plain data: the scanner's own texts, flexdt.json, and the geometry in them."""

"""Reading data sets, and exchanging their geometry with other programs."""

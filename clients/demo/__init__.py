"""The main job from end to end: processes, scan, and what can be learnt from the data set."""

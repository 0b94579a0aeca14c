"""Batches: thousands of scans or calibrations from one plan, resumable and reproducible.

`plan` reads what is wanted, `draws` and `items` say what each item is, `work` does one, `store`
keeps results, `run` puts them together, `cluster` asks SLURM for workers.
"""

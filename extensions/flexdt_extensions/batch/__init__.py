"""Batches: thousands of scans or calibrations from one plan, resumable and reproducible.

`plan` validates the TOML file, `draws` and `work` determine each item and compute it,
`batch_run` runs the whole and writes the results, `executors` provides workers.
"""

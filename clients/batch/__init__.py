"""Batches: thousands of scans or calibrations from one plan, resumable and reproducible.

`plan` validates the TOML file, `draws` and `work` determine each item and compute it,
`store` writes the results, `batch_run` runs the whole, `executors` provides workers.
"""

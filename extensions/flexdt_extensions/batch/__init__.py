"""Batches: thousands of scans or calibrations from one plan, resumable and reproducible.

`plan` validates the TOML file, `draws` and `work` determine each item and compute it,
`batch_run` runs the whole and writes the results on the workers of `flexdt_extensions.executors`.
"""

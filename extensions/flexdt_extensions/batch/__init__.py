"""Batches: thousands of scans or calibrations from one plan, resumable and reproducible.

`batch_plan` validates the TOML file, `work` determines each item and computes it,
`batch_run` runs all items and writes the results on the workers of
`flexdt_extensions.executors`.
"""

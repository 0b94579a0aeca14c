"""Batches: thousands of scans or calibrations from one plan, resumable and reproducible.

`plan` validates the TOML file, `draws` and `items` determine each item, `work` computes one,
`store` writes the results, `batch_run` runs the whole, `executors` and `cluster` provide workers.
"""

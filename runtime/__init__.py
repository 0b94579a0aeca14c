"""The needs of every process: event loop, access, log, metrics, workers, supervisor."""

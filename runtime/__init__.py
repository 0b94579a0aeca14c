"""What every process needs: event loop, access, log, metrics, workers, supervisor."""

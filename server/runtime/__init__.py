"""What every server process needs: event loop, access, log, metrics, workers, supervisor."""

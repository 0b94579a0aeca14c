"""The one mutable object, `ScannerTwin`, its state, and what may replace its motion."""

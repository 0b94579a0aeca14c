"""Commands about scans as data: predicted, simulated, calibrated, reconstructed, exchanged."""

"""What a laboratory's past scans tell of its machine: zero offsets, their drift, contradictions."""

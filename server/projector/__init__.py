"""The projector server: named volumes in, projections out, one compute thread, many clients."""

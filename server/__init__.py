"""The shell: twin server, projector server, viewer, data set writer. Only here wire meets
twin."""

"""The lab's servers as processes of this machine."""

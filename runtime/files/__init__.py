"""Files and folders that appear only when whole."""

"""From path lengths to counts, as the scanner makes them: tube, materials, panel, image quality."""

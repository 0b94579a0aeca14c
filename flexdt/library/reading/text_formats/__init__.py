"""Formats whose geometry is a text beside image files: Nikon, SkyScan, phoenix, YXLON."""

"""`flexdt follow`: a real scanner's messages, heard and compared with the twin."""

"""X-ray attenuation of substances, from tables of the elements."""

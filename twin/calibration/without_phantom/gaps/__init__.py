"""Which gaps between the tiles of a panel are borne out, in images of any object."""

"""How fast and how large the pieces are on this machine."""

"""Which geoms may touch, and where and how they do: contacts of MJX, with what it lacks."""

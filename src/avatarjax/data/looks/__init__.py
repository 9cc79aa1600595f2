"""One file an avatar: its shape, its clothes and its paint."""

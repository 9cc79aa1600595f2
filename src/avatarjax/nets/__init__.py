"""Network building blocks as Flax NNX modules, and the one adapter that makes them pure functions of plain dicts."""
